"""Driver of the Sony AIBO ERS-7 with Tekkotsu."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial

from twisted.internet.defer import Deferred, fail, gatherResults, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.aibo import menu, sensors
from drivers.aibo.codec import LineReader, StateReader, WorldState, encode_command
from drivers.aibo.link import RETRY_DELAYS_S, Camera, DatagramConnector, Port, UdpConnector
from drivers.aibo.menu import Hello, Load, MenuReader, select
from drivers.aibo.option import SOUNDS, Options, make_description, parse_options
from drivers.aibo.picture import Picture
from drivers.base import ENGAGED, BaseDriver, correct_last_data_time
from drivers.deadman.supervisor import create_switch
from drivers.deadman.switch import DeadManSwitch, HaltCommand
from drivers.driver import Permit
from drivers.errors import BadFrame, LinkLost, NotEnabled, Unsupported
from drivers.link import Connector, TcpConnector
from drivers.option import Manifest
from drivers.reading import Action, Description, Frame, Value
from drivers.timer import Timer

MANIFEST = Manifest(example={"host": "192.168.0.51"})

WALK_REPEAT_S = 0.5
"""Interval in seconds at which a walk command is repeated; the dog stops 3 s after the last one."""
CHECK_INTERVAL_S = 0.125
SERVER_RESTART_S = 1.0
"""Seconds without an answer from a port after which its server is started again through main control."""
MAIN_CONTROL_TIMEOUT_S = 3.0
"""Seconds to wait for main control before connecting to the other ports anyway."""
NO_ANSWER_S = 5.0
REQUIRED_SERVERS = ("estop", "state", "walk")
"""Servers without which the dog cannot be driven safely."""
SOUND_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}(\.[A-Za-z0-9]{1,4})?")


class AiboDriver(BaseDriver):
    """One dog, with a link to each of its ports by ``connector``; ``datagrams`` deliver pictures over UDP.

    The motors are off after ``connect``. The dog's own emergency stop (its back button, pressed twice) keeps the
    motors off until ``enable``. If a link is lost, or no world state arrives for ``STALE_S``, the walk ends and that
    link is reopened.
    """

    STALE_S = 0.5

    def __init__(
        self,
        options: Options | Mapping[str, object],
        name: str,
        connector: Connector,
        clock: IReactorTime,
        datagrams: DatagramConnector | None = None,
        dead_man: DeadManSwitch | None = None,
    ) -> None:
        self._options = options if isinstance(options, Options) else parse_options(options)
        super().__init__(make_description(self._options), name, clock, dead_man)
        self._connector = connector
        self._fps = self._options.wanted_fps
        self._ports = {
            "main": self._make_port("main", self._on_main_up, self._on_main),
            "estop": self._make_port("estop", self._on_estop_up, self._on_estop),
            "state": self._make_port("state", self._on_state_up, self._on_state),
            "walk": self._make_port("walk", self._check_up, lambda _: None),
            "head": self._make_port("head", lambda: None, lambda _: None),
        }
        address = (self._options.host, self._options.ports["camera"])
        over = datagrams if self._options.camera_transport == "udp" else None
        self._camera = Camera(connector, clock, address, self._on_picture, over)
        self._menu, self._lines, self._states = MenuReader(), LineReader(), StateReader()
        self._hello_count = 0
        self._main_opened_at: float | None = None
        self._is_engaged = True
        self._walk = (0.0, 0.0, 0.0)
        self._odometry = sensors.Odometry()
        self._last_data_at = self._next_check_at = 0.0
        self._frame: Frame | None = None
        self._started_servers: set[str] = set()
        self._logged_keys: set[str] = set()
        self._restarted_at: dict[str, float] = {}
        self._repeat_timer, self._check_timer = Timer(clock), Timer(clock)

    @property
    def camera_fps(self) -> float:
        """The requested frame rate in pictures per second."""
        return self._fps

    def set_camera_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops the camera server on the dog."""
        self._fps = fps
        if fps > 0:
            self._send_lines(self._start_lines(["camera"])[:-1])
            if self._hello_count >= 2:
                self._camera.open()
        else:
            self._send_lines(menu.make_stop_commands(["camera"]))
            self._camera.close()

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Run ``look`` (pan, tilt, nod in rad), ``play`` (sound: a file on the stick), or one of the dog's sounds."""
        try:
            if name == "look":
                return succeed(self._move_head(arguments))
            if name == "play":
                return succeed(self._play_sound(arguments))
            if name in SOUNDS and not arguments:
                self._get_open_port("walk").send(encode_command(SOUNDS[name], 0.0))
                return succeed({})
        except (Unsupported, LinkLost, NotEnabled) as error:
            return fail(error)
        return super().invoke(name, **arguments)

    def diagnostics(self) -> dict[str, float]:
        """The counters of every driver, and ``unanswered``, the number of ports that do not answer."""
        counts = super().diagnostics()
        counts["bad_frames"] += self._camera.bad_frames + self._menu.bad_lines + self._lines.bad_lines
        counts["bytes"] += self._camera.bytes
        counts["unanswered"] = sum(port.opened_at is not None and not port.is_up for port in self._all_ports().values())
        return counts

    # -- to the dog -------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._ports["main"].open()
        self._next_check_at = self._clock.seconds()
        self._check_links()

    def _close(self) -> Deferred[None]:
        self._repeat_timer.cancel()
        self._check_timer.cancel()
        self._ports["estop"].send(b"stop\n")
        self._send_lines(menu.make_stop_commands(sorted(self._started_servers)))
        closing = [port.close() for port in self._ports.values()] + [self._camera.close()]
        return gatherResults(closing).addCallback(lambda _: None)

    def _power(self, on: bool) -> None:
        if not on:
            self._halt()
        # The server reports changes only; "refresh" requests the state.
        self._ports["estop"].send(b"start\nrefresh\n" if on else b"stop\nrefresh\n")

    def _drive(self, motion: Action, permit: Permit) -> Action:
        forward, backward, aside, turn = self._options.speed
        vx, vy, wz = motion["base.vx"], motion["base.vy"], motion["base.wz"]
        r = wz / turn
        # Walking ahead, sideways and turning, all at full speed, would break the gait, so turning limits walking.
        left = 1.0 - abs(r)
        f = min(max(vx / (forward if vx > 0 else backward), -left), left)
        s = min(max(vy / aside, -left), left)
        self._send_walk(f, s, r)
        if abs(f) * (forward if f > 0 else backward) < abs(vx):
            vx = f * (forward if f > 0 else backward)
        if abs(s) * aside < abs(vy):
            vy = s * aside
        return {"base.vx": vx, "base.vy": vy, "base.wz": wz}

    def _halt(self) -> None:
        self._send_walk(0.0, 0.0, 0.0)

    def _make_halt_command(self) -> HaltCommand | None:
        link = self._ports["walk"].link
        return None if link is None else HaltCommand(_encode_walk(0.0, 0.0, 0.0), link)

    def _send_walk(self, f: float, s: float, r: float) -> None:
        self._repeat_timer.cancel()
        self._walk = (f, s, r)
        self._ports["walk"].send(_encode_walk(f, s, r))
        if any(self._walk):
            self._repeat_timer.set(WALK_REPEAT_S, self._on_repeat)

    def _on_repeat(self) -> None:
        if self._is_motion_permitted:
            self._send_walk(*self._walk)
        else:
            self.stop()

    def _start_lines(self, services: list[str]) -> list[str]:
        return menu.make_start_commands(services, self._options.camera_transport, self._fps, self._options.camera_width)

    def _send_lines(self, lines: list[str]) -> None:
        if lines:
            self._ports["main"].send("".join(line + "\n" for line in lines).encode("ascii"))

    def _move_head(self, arguments: Mapping[str, float | str]) -> dict[str, Value]:
        done: dict[str, Value] = {}
        commands = b""
        for key, value in arguments.items():
            if key not in _HEAD_AXES or isinstance(value, (bool, str)) or not -10.0 < value < 10.0:
                raise Unsupported(f"look takes pan, tilt and nod in radians, not {key} = {value!r}")
            letter, (low, high) = _HEAD_AXES[key]
            angle = min(max(float(value), low), high)
            commands += encode_command(letter, angle / high if angle > 0 else -angle / low if angle < 0 else 0.0)
            done[f"ptz.{key}"] = angle
        port = self._get_open_port("head")
        if self._is_engaged:
            raise NotEnabled(f"{self._name}'s motors are off; call enable() first")
        port.send(commands)
        return done

    def _play_sound(self, arguments: Mapping[str, float | str]) -> dict[str, Value]:
        name = arguments.get("sound")
        if len(arguments) != 1 or not isinstance(name, str) or not SOUND_NAME.fullmatch(name):
            raise Unsupported('play takes the name of a sound file on the stick, as in sound = "mew.wav"')
        self._get_open_port("main")
        self._send_lines(menu.make_sound_commands(name))
        return {}

    def _get_open_port(self, service: str) -> Port:
        port = self._ports[service]
        if self._is_closed or not port.is_up:
            raise LinkLost(f"{self._name} has no link to its {service} server; the driver is connecting")
        return port

    # -- from the dog -----------------------------------------------------------------------------------------------

    def _make_port(self, service: str, on_up: Callable[[], None], on_bytes: Callable[[bytes], None]) -> Port:
        def received(data: bytes) -> None:
            self._counts["bytes"] += len(data)
            on_bytes(data)

        address = (self._options.host, self._options.ports[service])
        return Port(self._connector, self._clock, address, on_up, partial(self._on_lost, service), received)

    def _all_ports(self) -> dict[str, Port]:
        return {**self._ports, "camera": self._camera.port}

    def _on_main_up(self) -> None:
        self._counts["bad_frames"] += self._menu.bad_lines
        self._menu, self._hello_count, self._main_opened_at = MenuReader(), 0, self._clock.seconds()
        services = [service for service in menu.SERVERS if service != "camera" or self._fps > 0]
        self._send_lines(menu.make_greeting() + self._start_lines(services))

    def _on_main(self, data: bytes) -> None:
        for message in self._menu.read(data):
            if isinstance(message, Hello):
                self._hello_count += 1
                if self._hello_count == 2:
                    self._open_ports()
            elif isinstance(message, Load):
                self._on_load(message.port)

    def _on_load(self, number: int) -> None:
        for service, port in self._all_ports().items():
            if port.number == number:
                self._started_servers.add(service)
                if port.opened_at is not None:
                    port.open()

    def _open_ports(self) -> None:
        """Connect to all servers, which have been started by now; retry waiting connections immediately."""
        self._main_opened_at = None
        for service, port in self._ports.items():
            if service != "main":
                port.open()
        if self._fps > 0:
            self._camera.open()

    def _on_estop_up(self) -> None:
        self._counts["bad_frames"] += self._lines.bad_lines
        self._lines, self._is_engaged = LineReader(), True
        self._check_up()

    def _on_estop(self, data: bytes) -> None:
        for line in self._lines.read(data):
            if line == "on":
                if self._wants_motors and not self._is_engaged:
                    self.log.warn("{robot}: its emergency stop was pressed; the motors are off", robot=self._name)
                    self._wants_motors = None
                    self.stop()
                self._is_engaged = True
            elif line == "off":
                self._is_engaged = self._wants_motors is not True
                if self._is_engaged:
                    # The dog's button released the stop; only enable() may switch the motors on, so stop again.
                    self._ports["estop"].send(b"stop\n")
            else:
                self._counts["bad_frames"] += 1

    def _on_state_up(self) -> None:
        self._states = StateReader()
        self._last_data_at = self._clock.seconds()
        self._odometry.restart_interval()
        self._frame = None
        self._check_up()

    def _on_state(self, data: bytes) -> None:
        try:
            for state in self._states.read(data):
                self._on_world_state(state)
        except BadFrame as error:
            # Packets have no start marker; only a new link starts with a packet.
            self._counts["bad_frames"] += 1
            self._log_once("state", f"port {self._ports['state'].number} sent an invalid world state: {error}")
            self._ports["state"].drop()

    def _on_world_state(self, state: WorldState) -> None:
        values: dict[str, Value] = {}
        if sensors.is_known(state):
            try:
                values = sensors.convert_state(state)
            except BadFrame as error:
                self._counts["bad_frames"] += 1
                self._log_once("sense", f"a world state was dropped: {error}")
                return
        else:
            self._log_once("model", f"the sensors of its model {state.model!r} are unknown; they are not reported")
        self._counts["frames"] += 1
        self._last_data_at = self._clock.seconds()
        self._logged_keys -= {"silence", "state"}
        forward, backward, aside, turn = self._options.speed
        f, s, r = (0.0, 0.0, 0.0) if self._is_engaged else self._walk
        motion = (f * (forward if f > 0 else backward), s * aside, r * turn)
        self._odometry.step(state.t, *motion)
        values.update(zip(("base.vx", "base.vy", "base.wz"), motion, strict=True))
        values |= {"base.moving": any(motion), ENGAGED: self._is_engaged, "mode": state.dialect}
        if self._is_up:
            self._observed({**values, **self._odometry.read_pose()}, self._odometry.t, frame=self._frame)

    def _on_picture(self, picture: Picture) -> None:
        self._counts["pictures"] += 1
        size = (picture.width, picture.height)
        t = self._odometry.convert_time(picture.t)
        self._frame = Frame(picture.number, *size, picture.data, t, picture.encoding)

    def _check_up(self) -> None:
        if self._is_up or self._is_closed or not all(self._ports[service].is_up for service in REQUIRED_SERVERS):
            return
        self._last_data_at = self._clock.seconds()
        self._halt()
        if not self._wants_motors:
            self._power(False)
        # After valid data, the next silence or invalid data is logged again.
        self._logged_keys &= {"silence", "sense", "state"}
        self._up()

    def _on_lost(self, service: str) -> None:
        if service in REQUIRED_SERVERS and self._is_up:
            self._halt()
            self._down()

    def _check_links(self) -> None:
        now = self._clock.seconds()
        self._last_data_at = correct_last_data_time(self._last_data_at, self._next_check_at, now)
        self._next_check_at = now + CHECK_INTERVAL_S
        self._check_timer.set(CHECK_INTERVAL_S, self._check_links)
        if (
            self._main_opened_at is not None
            and now - self._main_opened_at > MAIN_CONTROL_TIMEOUT_S
            and self._ports["main"].is_up
        ):
            self._log_once("main", "main control does not answer; connecting to the other ports anyway")
            self._open_ports()
        if self._ports["state"].is_up and now - self._last_data_at > self.STALE_S:
            self._last_data_at = now
            self._log_once("silence", f"no world state for {self.STALE_S:g} s; reconnecting")
            self._ports["state"].drop()
            # After a power cycle the dog has to be asked to start its servers again.
            self._ports["main"].drop()
        if self._camera.is_silent and self._ports["main"].is_up:
            self._restart_server("camera", 0.0)
        for service, port in self._all_ports().items():
            if port.is_up or port.opened_at is None:
                continue
            if service != "main":
                self._restart_server(service, port.opened_at)
            if now - port.opened_at > NO_ANSWER_S:
                where = f"{self._options.host}:{port.number}"
                why = "is it on, and does no other client hold the port (the dog takes one)?"
                self._log_once(service, f"its {service} server at {where} does not answer; {why}")

    def _restart_server(self, service: str, since: float) -> None:
        """Start a silent server through main control: a server of Tekkotsu 5 ends when its client disconnects."""
        now = self._clock.seconds()
        if now - max(since, self._restarted_at.get(service, 0.0)) > SERVER_RESTART_S:
            self._restarted_at[service] = now
            self._send_lines([select(name) for name in menu.SERVERS[service]])

    def _log_once(self, what: str, problem: str) -> None:
        if what not in self._logged_keys:
            self._logged_keys.add(what)
            self.log.warn("{robot}: {problem}", robot=self._name, problem=problem)


def _encode_walk(f: float, s: float, r: float) -> bytes:
    return encode_command("f", f) + encode_command("s", s) + encode_command("r", r)


_HEAD_AXES = {"pan": ("p", sensors.PAN), "tilt": ("t", sensors.TILT), "nod": ("r", sensors.NOD)}
"""The letter of each head axis in commands, and its range."""


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> AiboDriver:
    """Return a driver of the dog at the host in ``options``."""
    return AiboDriver(
        parse_options(options),
        name,
        TcpConnector(waits=RETRY_DELAYS_S) if connector is None else connector,
        clock,
        UdpConnector(clock),
        create_switch(name) if connector is None else None,
    )


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the dog that ``options`` select."""
    return make_description(parse_options(options))
