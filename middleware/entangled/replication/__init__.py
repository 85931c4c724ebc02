"""Replication: what a node holds for others, what it owns, reads and watches."""
