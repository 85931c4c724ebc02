"""Simulators: ``robots`` simulates robots, ``team`` teams of nodes in one process, ``namespaces`` an internet."""
