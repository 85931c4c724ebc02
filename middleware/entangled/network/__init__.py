"""Datagram networks: the interface, UDP, tunnels, and a simulated network in memory."""
