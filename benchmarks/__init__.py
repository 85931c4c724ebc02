"""Benchmarks: what the project costs and withstands; each module is a command."""
