"""Simulate whole teams in one process in virtual time: production nodes in an environment determined by a seed."""
