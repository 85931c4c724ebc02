"""A camera of this machine or a substitute source of pictures: a device that sees and cannot move."""
