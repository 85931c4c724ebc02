"""Simulation: ``robots`` stands in for robots, ``team`` for whole teams of nodes, ``namespaces`` for the internet."""
