"""Simulate trials of the tuple space: many takers, faults, and a record of all votes of council members."""
