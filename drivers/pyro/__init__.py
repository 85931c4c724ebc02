"""Pyro: a lab's robot as brains of 2011 knew it: ``robot.move(0.5, 0)``, ``robot.range``, over any driver."""
