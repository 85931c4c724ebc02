"""Fuzzing of the wire protocol: each target is a module with ``check(data)`` and can be run directly."""
