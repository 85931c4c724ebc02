"""Template of a driver.  The rover sends ``t x y yaw bumped motors`` 20 times per second, and obeys ``V`` and ``M``."""

import re

from drivers.base import ENGAGED, BaseDriver
from drivers.link import TcpConnector
from drivers.reading import Description

ABILITIES = {"base2d": {}, "odometry": {}, "bumper": {}, "estop": {}}
LIMITS = {"base.vx": (-0.3, 0.3), "base.wz": (-2.0, 2.0)}
ROVER = Description("rover", "Rover One", ABILITIES, LIMITS, radius=0.15, rates={"state": 20.0})
NUMBER = re.compile(rb"-?\d{1,9}(\.\d{1,9})?")


class Rover(BaseDriver):
    """Driver of one rover, over TCP."""

    def __init__(self, options, name, clock, connector):
        super().__init__(ROVER, name, clock)
        self._address = options["host"], options.get("port", 4000)
        self._connector = connector or TcpConnector()

    def _open(self):
        self._reconnector = self._connector.connect(*self._address, self)

    def _close(self):
        return self._reconnector.disconnect()

    def _power(self, on):
        self._link.send(b"M %d\n" % on)

    def _drive(self, motion, permit):
        self._link.send(b"V %.3f %.3f\n" % (motion["base.vx"], motion["base.wz"]))
        return motion

    def _halt(self):
        self._link.send(b"V 0 0\n")

    def link_up(self, link):  # noqa: D102 (interface of the connector, like data_received)
        self._link, self._tail = link, b""
        self._halt()
        self._up()

    def data_received(self, data):  # noqa: D102
        *lines, self._tail = (self._tail[-99:] + data).split(b"\n")
        for words in map(bytes.split, lines):
            is_whole = len(words) == 6 and all(map(NUMBER.fullmatch, words))
            self._counts["frames" if is_whole else "bad_frames"] += 1
            if is_whole:
                t, x, y, yaw, bumped, motors = map(float, words)
                pose = {"odom.x": x, "odom.y": y, "odom.yaw": yaw}
                self._observed({**pose, "bump.front": bumped > 0, ENGAGED: motors == 0}, t)

    link_down = BaseDriver._down
