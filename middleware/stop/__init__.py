"""Stops of the whole team: the set of stops and releases that a node knows, and their records."""
