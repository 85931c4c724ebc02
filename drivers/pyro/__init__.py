"""Pyro compatibility: ``robot.move(0.5, 0)``, ``robot.range``, for Pyro brains of 2011, over any driver."""
