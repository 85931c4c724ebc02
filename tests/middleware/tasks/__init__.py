"""Tests of tasks and orders."""
