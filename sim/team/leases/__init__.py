"""Simulate the agents, acceptors and devices of task leases only; a schedule takes some milliseconds."""
