"""Simulated agents, acceptors and devices of task leases; a schedule takes some milliseconds."""
