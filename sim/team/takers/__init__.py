"""Simulated trials of the tuple space: many takers, faults, and a record of what every council member accepted."""
