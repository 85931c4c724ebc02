"""Fuzzing of the wire: four targets, each a module with ``check(data)`` that runs by itself."""
