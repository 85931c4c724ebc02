"""Pyro compatibility: run Pyro brains of 2011 (``robot.move(0.5, 0)``, ``robot.range``) over any driver."""
