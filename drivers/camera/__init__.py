"""Cameras and substitute sources of pictures, as devices that see and cannot move."""
