"""Drivers: one interface in SI units for every kind of robot.

``driver`` defines the interface, ``reading`` the values that pass through it, ``errors`` the exceptions;
``registry`` finds the driver of a kind.  Each kind of robot has its own package.  This package does not use the
peer-to-peer network.
"""
