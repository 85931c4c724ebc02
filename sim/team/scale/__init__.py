"""Measure the cost and the latencies of teams against the number of their nodes."""
