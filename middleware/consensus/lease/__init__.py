"""Commitment: who may act.  A majority of a task's council grants one lease, with a fencing token that only grows."""
