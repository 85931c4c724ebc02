"""Replicas, own records, reads and watches of a node."""
