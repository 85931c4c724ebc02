"""SimDriver: a dog of the simulated yard, asked like any other robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.base import BaseDriver
from drivers.driver import Permit
from drivers.errors import Unsupported
from drivers.link import Connector, Line, Link, TcpConnector
from drivers.manifest import Manifest
from drivers.reading import Action, Description, Frame
from drivers.sim.codec import (
    VERSION,
    Alive,
    Drive,
    FrameReader,
    Halt,
    Hello,
    Message,
    Motors,
    Picture,
    Refused,
    Sensors,
    encoded,
)
from drivers.sim.option import Options, checked, described

MANIFEST = Manifest()

ALIVE_S = 0.5


class SimDriver(BaseDriver):
    """One dog of the yard, through links that ``connector`` opens.

    After ``connect`` the motors are off and ``estop.engaged`` is true until ``enable``.  ``connect`` fails with
    ``Unsupported`` where the yard has no such robot; while another driver holds it, it is asked for again until it is
    free.
    """

    def __init__(self, options: Options | Mapping[str, object], connector: Connector, clock: IReactorTime) -> None:
        self._options = options if isinstance(options, Options) else checked(options)
        super().__init__(described(self._options), self._options.robot, clock)
        self._connector = connector
        self._line: Line | None = None
        self._link: Link | None = None
        self._reader = FrameReader()
        self._has_problem = False
        self._alive: Any = None
        self._frame: Frame | None = None

    @property
    def camera_fps(self) -> float:
        """Pictures a second that the camera is asked for."""
        return self._options.wanted_fps

    def set_camera_fps(self, fps: float) -> None:
        """Ask the camera for so many pictures a second from now on; 0: none."""
        self._options = replace(self._options, camera_fps=fps)
        self._send(Hello(VERSION, self._options.robot, self._options.wanted_fps))

    # -- to the yard ------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._line = self._connector.call(self._options.host, self._options.port, self)

    def _close(self) -> Deferred[None]:
        self._stop_alive()
        return succeed(None) if self._line is None else self._line.hang_up()

    def _power(self, on: bool) -> None:
        self._send(Motors(on))

    def _drive(self, motion: Action, permit: Permit) -> Action:
        now, newest = self._clock.seconds(), self._newest
        assert newest is not None  # nothing is driven before
        sent = newest.t_robot + (now - newest.t_host)
        vx, vy, wz = motion["base.vx"], motion["base.vy"], motion["base.wz"]
        self._send(Drive(vx, vy, wz, permit.token, permit.deadline - now, sent))
        return motion

    def _halt(self) -> None:
        self._send(Halt())

    # -- from the yard ----------------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Ask the yard for the robot; called by the line."""
        self._link = link
        self._reader = FrameReader()
        self._send(Hello(VERSION, self._options.robot, self._options.wanted_fps))
        self._up()
        self._keep_alive()

    def link_down(self) -> None:
        """Bring the motion to rest here, as the yard does there; called by the line."""
        self._link = None
        self._stop_alive()
        self._down()

    def received(self, data: bytes) -> None:
        """Take bytes from the yard; called by the line."""
        self._counts["bytes"] += len(data)
        bad = self._reader.bad_frames
        for message in self._reader.read(data):
            if self._is_closed:
                return
            self._counts["frames"] += 1
            self._on_message(message)
        self._counts["bad_frames"] += self._reader.bad_frames - bad

    def _on_message(self, message: Message) -> None:
        match message:
            case Sensors():
                self._gate.learn(message.token)
                self._has_problem = False
                self._observed(message.values, float(message.t), message.samples, self._frame)
            case Picture():
                self._counts["pictures"] += 1
                self._frame = Frame(message.seq, message.width, message.height, message.data, message.t)
            case Refused():
                self._on_refused(message)
            case _:
                self._counts["bad_frames"] += 1

    def _on_refused(self, message: Refused) -> None:
        self._counts["refused"] += 1
        if message.lasting:
            self._refused(Unsupported(message.reason))
            return
        if not self._has_problem:
            self.log.warn("yard: {reason}; asking again", reason=message.reason)
        self._has_problem = True

    def _send(self, message: Message) -> None:
        if self._link is not None:
            self._link.send(encoded(message))

    def _keep_alive(self) -> None:
        self._send(Alive())
        self._alive = self._clock.callLater(ALIVE_S, self._keep_alive)

    def _stop_alive(self) -> None:
        if self._alive is not None and self._alive.active():
            self._alive.cancel()
        self._alive = None


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> SimDriver:
    """A driver of the dog that ``options`` or else the device's ``name`` names."""
    return SimDriver(_named(options, name), TcpConnector(says=True) if connector is None else connector, clock)


def describe(options: Mapping[str, object], name: str) -> Description:
    """What that dog is."""
    return described(_named(options, name))


def _named(options: Mapping[str, object], name: str) -> Options:
    return checked({"robot": name, **options})
