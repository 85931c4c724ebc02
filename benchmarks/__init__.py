"""Benchmarks: commands that measure resources and print tables."""
