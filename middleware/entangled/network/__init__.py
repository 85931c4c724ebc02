"""Datagram ports: the interface, the real one, and the one in memory."""
