"""Conformance tests of the example driver."""

from functools import partial

from emulator import Emulator
from robot import Rover
from twisted.trial.unittest import SynchronousTestCase

from drivers.conformance import Conformance, MemoryRig


class RoverTests(Conformance, SynchronousTestCase):
    """The driver of the rover passes the conformance tests."""

    rig = partial(MemoryRig, Rover, Emulator, {"host": "rover"})
