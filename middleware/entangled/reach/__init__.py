"""Reach: how a node is reached that is not where others see it: introduced, or carried to by others."""
