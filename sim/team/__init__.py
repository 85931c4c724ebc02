"""Simulate whole teams in one process in virtual time: production nodes in an environment that follows from a seed."""
