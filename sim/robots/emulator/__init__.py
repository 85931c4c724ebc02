"""Emulators: the robots' side of each protocol, for bodies of the simulator."""
