"""Emulators: the robots' side of each protocol, for simulated robots."""
