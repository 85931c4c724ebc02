"""An emulated compass that sends a simulated robot's heading as NMEA 0183, to a cable or any number of clients."""

from __future__ import annotations

import math
import random
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.compass.codec import encode_sentence, format_angle
from drivers.compass.option import parse_options
from sim.robots.emulator.output import Broadcast, Client
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, PtyEmulatorServer, Table, TcpEmulatorServer


class NmeaCompass(Broadcast[Client]):
    """One compass, on a cable or on the network; north is the direction of the map's y axis.

    ``kinds`` are the sentences of each report. ``deviation`` is the error of the sensor and ``variation`` the error of
    magnetic north, in degrees to the east; ``HDG`` contains both values, and ``HDM`` is corrected by the deviation.
    For a robot without ``compass.heading`` the heading is empty. ``faults`` corrupts the data.
    """

    make_client = Client

    def __init__(self, clock: IReactorTime, robot: SimulatedRobot, rate: float = 10.0) -> None:
        super().__init__(clock, robot, rate)
        self.kinds: tuple[str, ...] = ("HDG",)
        self.deviation = 0.0
        self.variation = 0.0

    def _broadcast(self) -> None:
        heading = self._robot.sense().get("compass.heading")
        true = math.nan if heading is None else 90.0 - math.degrees(float(heading))
        sentences = b"".join(self._make_sentence(kind, true) for kind in self.kinds)
        for client in self.clients:
            if not client.link.is_busy:
                client.output.send(sentences)

    def _make_sentence(self, kind: str, true: float) -> bytes:
        off = {"HDG": self.variation + self.deviation, "HDM": self.variation}.get(kind, 0.0)
        # Round first, so that 359.96 becomes 0.0 and not 360.0.
        degrees = "" if math.isnan(true) else f"{round(true - off, 1) % 360.0:.1f}"
        if kind == "HDG":
            return encode_sentence("HCHDG", degrees, *format_angle(self.deviation), *format_angle(self.variation))
        return encode_sentence(f"HC{kind}", degrees, kind[2])


def serve(reactor: Any, robot: SimulatedRobot, rng: random.Random, options: Table, dialect: str) -> EmulatorServer:
    """Return the server of a compass: a pseudo-terminal, or TCP."""
    args = parse_options(options)
    compass = NmeaCompass(reactor, robot)
    if args.device:
        return PtyEmulatorServer(reactor, compass, args.device)
    return TcpEmulatorServer(reactor, compass, compass.accept, args.host, args.port)
