"""Emulators: the robots' side of the wire, over bodies that the yard moves."""
