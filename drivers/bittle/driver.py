"""Driver of Petoi's robot dog Bittle, over a cable or Wi-Fi.

A gait continues until the next skill, because the robot has no time-out. The driver therefore ends each motion at its
deadline; if this process freezes, a dead man's switch ends the motion. A walking dog whose link is lost keeps walking.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from twisted.internet.defer import Deferred, fail
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from drivers.base import ENGAGED, LinkedDriver
from drivers.bittle import codec
from drivers.bittle.gait import REST, STAND, Velocity, select_gait
from drivers.bittle.link import HttpConnector, HttpLink
from drivers.bittle.option import JOINT_LIMITS, JOINT_NAMES, Options, make_description, parse_options
from drivers.bittle.request_table import RequestTable
from drivers.deadman.supervisor import create_switch
from drivers.deadman.switch import DeadManSwitch, HaltCommand
from drivers.driver import Permit
from drivers.errors import BadFrame, DriverError, LinkLost, NotEnabled, Unsupported
from drivers.link import Connector, Link, TcpConnector
from drivers.option import Manifest
from drivers.reading import Action, Description, Value
from drivers.serial import SerialConnector

MANIFEST = Manifest("serial", "serial", "on a cable", {"port": "/dev/ttyUSB0"}, is_on_cable=True)

VERSION_TIMEOUT_S = 1.0
"""Seconds to wait for the robot's version before asking again: the robot may be booting."""
POLL_S, HTTP_POLL_S = 0.05, 0.2
POLL_TIMEOUT_S = 1.0
GAIT_RETRY_S = 1.0
"""Seconds after which an unanswered gait command is repeated."""
REST_RETRY_S = 2.0
"""Seconds after which an unanswered command to lie down is repeated."""
SKILL_TIMEOUT_S = 15.0
"""Maximum duration of a behaviour in seconds; the longest known behaviours take about eight seconds."""
MAX_MISSED_POLLS = 3
"""Missing answers after which an old value is dropped; if all polls fail, the driver asks for the version again."""
BATTERY_POLL_PERIOD = 20
"""The battery voltage is requested in one of this many polls."""
EMPTY_V, FULL_V = 6.8, 8.4
"""Voltages of the two lithium cells in series, empty and full."""


class BittleDriver(LinkedDriver):
    """One dog.

    ``enable`` makes the dog stand up. ``disable`` makes it lie down with its servos off, which is also its state after
    ``connect``. ``act`` returns the velocity of the nearest gait; odometry integrates this velocity.
    """

    SWITCH_S = 4.0

    def __init__(
        self,
        options: Options,
        name: str,
        connector: Connector,
        clock: IReactorTime,
        dead_man: DeadManSwitch | None = None,
    ) -> None:
        endpoint = (options.host, options.http_port) if options.host else (options.port, int(options.baud))
        super().__init__(make_description(options), name, clock, connector, endpoint, dead_man)
        self.STALE_S = 2.0 if options.host else 1.0
        self._options = options
        self._gaits = dict(options.gaits)
        self._moving_commands = {codec.encode_skill(name) for name, velocity in options.gaits if velocity != REST}
        self._requests = RequestTable(clock, self._send)
        self._board = ""
        self._version_timeout_s = VERSION_TIMEOUT_S
        self._requested_gait = ""
        self._is_gait_certain = True
        self._velocity = REST
        self._velocity_since = clock.seconds()
        self._pose = (0.0, 0.0, 0.0)
        self._is_lying = True
        self._running_skill = ""
        self._poll_count = 0
        self._missed_polls: dict[str, int] = {}
        self._values: dict[str, dict[str, Value]] = {}

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Run a posture or behaviour to its end; ``joint`` turns joints, given by name, to angles in radians."""
        if name not in self._description.skills:
            return super().invoke(name, **arguments)
        if not self._is_up or self.state in ("stale", "closed"):
            return fail(LinkLost(f"{self._name} is {self.state}; connect first, or wait for the link"))
        if self._is_lying or self._wants_motors is not True:
            return fail(NotEnabled(f"{self._name}'s motors are off; call enable() first"))
        if self._running_skill:
            return fail(NotEnabled(f"{self._name} is busy with {self._running_skill}; wait until it is done"))
        try:
            command = self._make_joint_command(arguments) if name == "joint" else codec.encode_skill(name)
            if name != "joint" and arguments:
                raise Unsupported(f"{name} takes no arguments")
        except Unsupported as error:
            return fail(error)
        # The skill replaces a running gait.
        self._clear_motion()
        self._update_odometry()
        self._velocity, self._requested_gait, self._running_skill = REST, "", name
        # The robot does not answer polls while the skill runs.
        self.STALE_S += SKILL_TIMEOUT_S
        return self._requests.request(command, SKILL_TIMEOUT_S).addBoth(self._on_skill_done, name)

    def act(self, action: Action, permit: Permit) -> Action:
        """Perform ``action``; raises ``NotEnabled`` also while a skill runs, because that would delay the action."""
        if self._running_skill:
            raise NotEnabled(f"{self._name} is busy with {self._running_skill}; wait until it is done")
        return super().act(action, permit)

    # -- to the robot -----------------------------------------------------------------------------------------------

    def _open(self) -> None:
        super()._open()
        if isinstance(self._reconnector, HttpLink):
            self._reconnector.should_send = self._should_send

    def _close(self) -> Deferred[None]:
        self._send(codec.REST)
        self._requests.fail_all(LinkLost(f"{self._name}: disconnected"))
        return super()._close()

    def _power(self, on: bool) -> None:
        if on:
            self._request_gait(STAND, REST)
        else:
            self._lie_down()

    def _drive(self, motion: Action, permit: Permit) -> Action:
        name, velocity = select_gait(motion.get("base.vx", 0.0), motion.get("base.wz", 0.0), self._gaits)
        if name != self._requested_gait or not self._is_gait_certain:
            self._request_gait(name, velocity)
        return {key: getattr(velocity, key.removeprefix("base.")) for key in motion}

    def _halt(self) -> None:
        # A dog whose servos are off would stand up.
        if self._wants_motors is True:
            self._request_gait(STAND, REST)

    def _make_halt_command(self) -> HaltCommand | None:
        halt = codec.encode_skill(STAND)
        if self._link is None or not isinstance(self._reconnector, HttpLink):
            return None if self._link is None else HaltCommand(halt, self._link)
        return HaltCommand(self._reconnector.encode_command_request(halt), self._link, self._reconnector.address)

    def _request_gait(self, name: str, velocity: Velocity) -> None:
        self._requested_gait, self._is_gait_certain = name, True
        patience = GAIT_RETRY_S + (SKILL_TIMEOUT_S if self._running_skill else 0.0)
        self._requests.request(codec.encode_skill(name), patience).addCallbacks(
            lambda _: self._on_gait(name, velocity), lambda failure: self._on_no_gait(name, velocity, failure)
        )

    def _on_gait(self, name: str, velocity: Velocity) -> None:
        self._is_lying = False
        self._update_odometry()
        self._velocity = velocity
        self._publish("base", {})

    def _on_no_gait(self, name: str, velocity: Velocity, failure: Failure) -> None:
        if failure.check(Unsupported):
            self._counts["refused"] += 1
            self.log.error("{robot}: {error}; remove it from the option gaits", robot=self._name, error=failure.value)
        elif self._is_up and self._requested_gait == name and not self._is_closed:
            if velocity == REST or self._is_motion_permitted:
                self._request_gait(name, velocity)
            else:
                self.stop()

    def _lie_down(self) -> None:
        self._requested_gait = ""
        self._requests.request(codec.REST, REST_RETRY_S).addCallbacks(self._on_lying, self._on_not_lying)

    def _on_lying(self, _lines: list[str]) -> None:
        self._is_lying = True
        self._update_odometry()
        self._velocity = REST
        self._publish("base", {})

    def _on_not_lying(self, _failure: Failure) -> None:
        if self._is_up and not self._is_closed and not self._requested_gait and not self._running_skill:
            self._lie_down()

    def _make_joint_command(self, arguments: Mapping[str, float | str]) -> bytes:
        numbers = {name: joint for joint, name in JOINT_NAMES.items()}
        wanted: list[float] = []
        for name, angle in arguments.items():
            if name not in numbers:
                raise Unsupported(f"there is no joint {name!r}; known are {', '.join(numbers)}")
            if isinstance(angle, (bool, str)) or not math.isfinite(angle):
                raise Unsupported(f"{name} must be a finite number of radians, not {angle!r}")
            low, high = JOINT_LIMITS[name]
            wanted += [numbers[name], min(max(math.degrees(angle), low), high)]
        if not wanted:
            raise Unsupported("joint needs an angle, as in joint(head_pan=0.5)")
        return codec.encode_text_command("i", *wanted)

    def _on_skill_done(self, result: list[str] | Failure, name: str) -> Mapping[str, Value] | Failure:
        self._running_skill = ""
        self.STALE_S -= SKILL_TIMEOUT_S
        return result if isinstance(result, Failure) else {"skill.done": name}

    def _should_send(self, command: bytes) -> bool:
        return self._is_motion_permitted or command not in self._moving_commands

    # -- from the robot ---------------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Ask for the version; called by the link."""
        self._link = link
        self._version_timeout_s = VERSION_TIMEOUT_S
        self._reader = codec.LineReader()
        self._request_version()

    def link_down(self) -> None:
        """Reset the motion in this driver; the dog keeps its gait until it is reachable again. Called by the link."""
        self._link = None
        self._on_lost(LinkLost(f"the link to {self._name} was lost"))

    def _on_message(self, line: str) -> None:
        if codec.is_banner(line) and self._is_up:
            self._on_lost(LinkLost(f"{self._name} restarted"))
            self._request_version()
        else:
            self._requests.process_line(line)

    def _on_lost(self, error: Exception) -> None:
        self._timer.cancel()
        is_up, self._is_up = self._is_up, False
        self._requested_gait = ""
        self._update_odometry()
        self._velocity = REST
        self._is_lying = True
        self._requests.fail_all(error)
        if is_up or self._link is None:
            self._down()

    def _request_version(self) -> None:
        self._timer.cancel()
        self._requests.request(codec.VERSION, self._version_timeout_s).addCallbacks(
            self._on_version, self._on_no_version
        )

    def _on_version(self, lines: list[str]) -> None:
        board = codec.parse_board(lines)
        self._board = self._options.board if self._options.board != "auto" else board or "biboard"
        if board and board != self._board:
            self._set_problem(f"this robot has a {board}, but the option board is {self._board}; correct the option")
        else:
            self._problem = ""
        self._values = {"mode": {"mode": self._board}}
        self._missed_polls = {}
        # The dog's state is unknown, so the first command makes it lie down and switches its servos off.
        self._lie_down()
        self._up()
        self._schedule_poll()

    def _on_no_version(self, failure: Failure) -> None:
        if self._link is None or self._is_closed:
            return
        self._set_problem(
            f"the robot does not report its version; is it switched on, and is {self._options.baud} baud correct?"
            if self._options.port
            else "the robot does not report its version; is it switched on, and does its firmware have a web server?"
        )
        self._version_timeout_s = min(self._version_timeout_s * 1.5, 5.0)
        if not failure.check(LinkLost):
            self._request_version()

    def _schedule_poll(self) -> None:
        self._timer.set(HTTP_POLL_S if self._options.host else POLL_S, self._send_poll)

    def _send_poll(self) -> None:
        if self._running_skill:
            self._schedule_poll()
            return
        polls = self._list_polls()
        self._poll_count += 1
        is_slow = self._poll_count % BATTERY_POLL_PERIOD == 0 and self._board != "nyboard"
        key = "power" if is_slow else list(polls)[self._poll_count % len(polls)]
        command, read = (codec.VOLTAGE, _read_power) if is_slow else polls[key]
        answered = self._requests.request(command, POLL_TIMEOUT_S)
        answered.addCallback(self._on_answer, key, read).addErrback(self._on_no_answer, key)

    def _list_polls(self) -> dict[str, tuple[bytes, Callable[[list[str]], dict[str, Value]]]]:
        polls: dict[str, tuple[bytes, Callable[[list[str]], dict[str, Value]]]] = {
            "imu": (codec.NYBOARD_ATTITUDE, _read_nyboard_imu)
            if self._board == "nyboard"
            else (codec.ATTITUDE, _read_imu),
            "joint": (codec.JOINT_ANGLES, _read_joints),
        }
        if self._options.ultrasonic is not None:
            polls["range"] = (codec.encode_ultrasonic(*self._options.ultrasonic), _read_range)
        return polls

    def _on_answer(self, lines: list[str], key: str, read: Callable[[list[str]], dict[str, Value]]) -> None:
        self._missed_polls[key] = 0
        try:
            values = read(lines)
        except BadFrame:
            self._counts["bad_frames"] += 1
        else:
            self._counts["frames"] += 1
            self._publish(key, values)
        if self._is_up and not self._is_closed:
            self._schedule_poll()

    def _on_no_answer(self, failure: Failure, key: str) -> None:
        failure.trap(DriverError)
        if not self._is_up or self._is_closed:
            return
        self._missed_polls[key] = self._missed_polls.get(key, 0) + 1
        # The dog may have restarted and be lying down: the next action sends its gait again.
        self._is_gait_certain = False
        if self._missed_polls[key] >= MAX_MISSED_POLLS:
            self._values.pop(key, None)
        polls = self._list_polls()
        if all(self._missed_polls.get(one, 0) >= MAX_MISSED_POLLS for one in polls):
            self._set_problem("the robot does not answer; is it switched on, and in range?")
            self._on_lost(LinkLost(f"{self._name} does not answer"))
            self._request_version()
        else:
            self._schedule_poll()

    def _publish(self, key: str, values: dict[str, Value]) -> None:
        self._values[key] = values
        self._update_odometry()
        x, y, yaw = self._pose
        vx, wz = self._velocity
        observed: dict[str, Value] = {"odom.x": x, "odom.y": y, "odom.yaw": yaw, ENGAGED: self._is_lying}
        observed |= {"base.vx": vx, "base.vy": 0.0, "base.wz": wz, "base.moving": self._velocity != REST}
        observed["skill.running"] = self._running_skill or (self._requested_gait if self._velocity != REST else "")
        for group in self._values.values():
            observed |= group
        # The robot sends no time stamps, so the time of arrival is used.
        self._observed(observed, self._clock.seconds())

    def _update_odometry(self) -> None:
        now = self._clock.seconds()
        span, self._velocity_since = now - self._velocity_since, now
        x, y, yaw = self._pose
        middle = yaw + self._velocity.wz * span / 2.0
        x += self._velocity.vx * span * math.cos(middle)
        y += self._velocity.vx * span * math.sin(middle)
        self._pose = (x, y, math.remainder(yaw + self._velocity.wz * span, math.tau))


def _read_imu(lines: list[str]) -> dict[str, Value]:
    return {f"imu.{key}": angle for key, angle in codec.parse_attitude(lines).items()}


def _read_nyboard_imu(lines: list[str]) -> dict[str, Value]:
    return {f"imu.{key}": angle for key, angle in codec.parse_nyboard_attitude(lines).items()}


def _read_joints(lines: list[str]) -> dict[str, Value]:
    angles = codec.parse_joints(lines)
    return {f"joint.{JOINT_NAMES[joint]}.pos": angle for joint, angle in angles.items() if joint in JOINT_NAMES}


def _read_range(lines: list[str]) -> dict[str, Value]:
    return {"range.front": codec.parse_distance(lines)}


def _read_power(lines: list[str]) -> dict[str, Value]:
    volts = codec.parse_voltage(lines)
    return {"power.volts": volts, "power.level": min(max((volts - EMPTY_V) / (FULL_V - EMPTY_V), 0.0), 1.0)}


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> BittleDriver:
    """Return a driver of the dog at the serial device or the address in ``options``."""
    checked_options = parse_options(options)
    dead_man = create_switch(name) if connector is None else None
    if checked_options.host:
        over = TcpConnector() if connector is None else connector
        return BittleDriver(checked_options, name, HttpConnector(over, clock, checked_options.board), clock, dead_man)
    return BittleDriver(checked_options, name, SerialConnector() if connector is None else connector, clock, dead_man)


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the dog that ``options`` select."""
    return make_description(parse_options(options))
