"""``swarm service``: run a node as a systemd service."""
