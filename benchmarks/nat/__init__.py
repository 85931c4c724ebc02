"""Measure real nodes behind every pair of NATs, in network namespaces (``make live-nat``)."""
