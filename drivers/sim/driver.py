"""Driver of a simulated dog."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from twisted.internet.interfaces import IReactorTime

from drivers.base import LinkedDriver
from drivers.driver import Permit
from drivers.errors import Unsupported
from drivers.link import Connector, Link, TcpConnector
from drivers.option import Manifest
from drivers.reading import Action, Description, Frame
from drivers.sim.codec import (
    VERSION,
    Drive,
    FrameReader,
    Halt,
    Hello,
    KeepAlive,
    Message,
    Motors,
    Picture,
    Refused,
    Sensors,
    encode_message,
)
from drivers.sim.option import Options, make_description, parse_options

MANIFEST = Manifest()

KEEP_ALIVE_S = 0.5


class SimDriver(LinkedDriver):
    """One dog of the simulator, over links that ``connector`` opens.

    After ``connect`` the motors are off and ``estop.engaged`` is true until ``enable``.  ``connect`` fails with
    ``Unsupported`` if the simulator has no such robot; while another driver uses the robot, the request is repeated.
    """

    def __init__(self, options: Options | Mapping[str, object], connector: Connector, clock: IReactorTime) -> None:
        self._options = options if isinstance(options, Options) else parse_options(options)
        endpoint = (self._options.host, self._options.port)
        super().__init__(make_description(self._options), self._options.robot, clock, connector, endpoint)
        self._has_problem = False
        self._frame: Frame | None = None

    @property
    def camera_fps(self) -> float:
        """The requested frame rate in pictures per second."""
        return self._options.wanted_fps

    def set_camera_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops."""
        self._options = replace(self._options, camera_fps=fps)
        self._send_message(Hello(VERSION, self._options.robot, self._options.wanted_fps))

    # -- to the simulator -------------------------------------------------------------------------------------------

    def _power(self, on: bool) -> None:
        self._send_message(Motors(on))

    def _drive(self, motion: Action, permit: Permit) -> Action:
        now, newest = self._clock.seconds(), self._newest
        assert newest is not None  # act() requires an observation
        sent = newest.t_robot + (now - newest.t_host)
        vx, vy, wz = motion["base.vx"], motion["base.vy"], motion["base.wz"]
        self._send_message(Drive(vx, vy, wz, permit.token, permit.deadline - now, sent))
        return motion

    def _halt(self) -> None:
        self._send_message(Halt())

    # -- from the simulator -----------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Request the robot; called by the link."""
        self._link = link
        self._reader = FrameReader()
        self._send_message(Hello(VERSION, self._options.robot, self._options.wanted_fps))
        self._up()
        self._keep_alive()

    def link_down(self) -> None:
        """Reset the motion, as the simulator also does; called by the link."""
        self._link = None
        self._timer.cancel()
        self._down()

    def _on_message(self, message: Message) -> None:
        self._counts["frames"] += 1
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
            self.log.warn("simulator: {reason}; retrying", reason=message.reason)
        self._has_problem = True

    def _send_message(self, message: Message) -> None:
        self._send(encode_message(message))

    def _keep_alive(self) -> None:
        self._send_message(KeepAlive())
        self._timer.set(KEEP_ALIVE_S, self._keep_alive)


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> SimDriver:
    """Return a driver of the dog that ``options`` or else the device's ``name`` selects."""
    return SimDriver(_parse_options(options, name), TcpConnector(says=True) if connector is None else connector, clock)


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the dog that ``options`` select."""
    return make_description(_parse_options(options, name))


def _parse_options(options: Mapping[str, object], name: str) -> Options:
    return parse_options({"robot": name, **options})
