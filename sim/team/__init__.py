"""Whole teams in one process, on one turned clock: the nodes that ship, in a world that follows from a seed."""
