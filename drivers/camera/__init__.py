"""A camera of this machine, or pictures in its place: a device that sees and cannot move."""
