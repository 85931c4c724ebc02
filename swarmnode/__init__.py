"""Composition of nodes from settings, the ``swarm`` and ``sim`` commands, and a simulated team in memory."""
