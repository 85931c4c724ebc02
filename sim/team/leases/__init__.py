"""Simulated agents, acceptors and devices of task leases, without the rest of a node: a thousand schedules in a minute."""
