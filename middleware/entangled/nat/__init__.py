"""NAT traversal: introductions with hole punching, relays, and the external address of a node."""
