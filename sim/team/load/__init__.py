"""Workloads of clients in a simulated team, with their figures."""
