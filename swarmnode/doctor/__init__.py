"""``swarm doctor``: diagnose the connection of a node to its team from measurements."""
