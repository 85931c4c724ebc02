"""AiboDriver: a Sony ERS-7 that runs Tekkotsu, asked like any other robot."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial

from twisted.internet.defer import Deferred, fail, gatherResults, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.aibo import menu, sense
from drivers.aibo.codec import LineReader, StateReader, WorldState, command
from drivers.aibo.link import WAITS, Camera, Datagrams, Port, UdpDatagrams
from drivers.aibo.menu import Hello, Load, MenuReader, select
from drivers.aibo.option import SOUNDS, Options, checked, described
from drivers.aibo.picture import Picture
from drivers.base import ENGAGED, BaseDriver, heard_at
from drivers.deadman.keeper import kept
from drivers.deadman.switch import DeadMan, LastWord
from drivers.driver import Permit
from drivers.errors import BadFrame, LinkLost, NotEnabled, Unsupported
from drivers.link import Connector, TcpConnector
from drivers.option import Manifest
from drivers.reading import Action, Description, Frame, Value
from drivers.timer import Timer

MANIFEST = Manifest(example={"host": "192.168.0.51"})

AGAIN_S = 0.5
"""A live walk is said again so often; the dog stops by itself 3 s after it heard the last one."""
WATCH_S = 0.125
ASK_S = 1.0
"""A port that does not answer for so long is asked for again at main control."""
STARTED_S = 3.0
"""Main control that has not answered after so long may never do so: the ports are tried all the same."""
PATIENCE_S = 5.0
NEEDED = ("estop", "state", "walk")
"""Without one of these the dog can neither be driven nor be trusted."""
ANY_SOUND = re.compile(r"[A-Za-z0-9_-]{1,32}(\.[A-Za-z0-9]{1,4})?")


class AiboDriver(BaseDriver):
    """One dog, over a link for each of its ports that ``connector`` opens; ``datagrams`` bring pictures over UDP.

    The motors are off after ``connect``.  Who presses the dog's own switch (its back, twice) keeps them off until
    ``enable``.  A lost link, or ``STALE_S`` without a world state, brings the walk to rest and opens that link again.
    """

    STALE_S = 0.5

    def __init__(
        self,
        options: Options | Mapping[str, object],
        name: str,
        connector: Connector,
        clock: IReactorTime,
        datagrams: Datagrams | None = None,
        dead_man: DeadMan | None = None,
    ) -> None:
        self._options = options if isinstance(options, Options) else checked(options)
        super().__init__(described(self._options), name, clock, dead_man)
        self._connector = connector
        self._fps = self._options.wanted_fps
        self._ports = {
            "main": self._port("main", self._on_main_up, self._on_main),
            "estop": self._port("estop", self._on_estop_up, self._on_estop),
            "state": self._port("state", self._on_state_up, self._on_state),
            "walk": self._port("walk", self._check_up, lambda _: None),
            "head": self._port("head", lambda: None, lambda _: None),
        }
        address = (self._options.host, self._options.ports["camera"])
        over = datagrams if self._options.camera_transport == "udp" else None
        self._camera = Camera(connector, clock, address, self._on_picture, over)
        self._menu, self._lines, self._states = MenuReader(), LineReader(), StateReader()
        self._hellos = 0
        self._main_at: float | None = None
        self._is_engaged = True
        self._walk = (0.0, 0.0, 0.0)
        self._odometry = sense.Odometry()
        self._heard_at = self._watch_at = 0.0
        self._frame: Frame | None = None
        self._started: set[str] = set()
        self._named: set[str] = set()
        self._asked_at: dict[str, float] = {}
        self._again, self._watch = Timer(clock), Timer(clock)

    @property
    def camera_fps(self) -> float:
        """Pictures a second that the camera is asked for."""
        return self._fps

    def set_camera_fps(self, fps: float) -> None:
        """Ask the camera for so many pictures a second from now on; 0: none, and its server on the dog stops."""
        self._fps = fps
        if fps > 0:
            self._tell(self._start_lines(["camera"])[:-1])
            if self._hellos >= 2:
                self._camera.open()
        else:
            self._tell(menu.stopped(["camera"]))
            self._camera.close()

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """``look`` (pan, tilt, nod in rad), ``play`` (sound: a file on the stick), or one of the dog's sounds."""
        try:
            if name == "look":
                return succeed(self._look(arguments))
            if name == "play":
                return succeed(self._play(arguments))
            if name in SOUNDS and not arguments:
                self._need("walk").send(command(SOUNDS[name], 0.0))
                return succeed({})
        except (Unsupported, LinkLost, NotEnabled) as error:
            return fail(error)
        return super().invoke(name, **arguments)

    def diagnostics(self) -> dict[str, float]:
        """As every driver's; ``unanswered`` are the ports that are called and do not answer."""
        counts = super().diagnostics()
        counts["bad_frames"] += self._camera.bad_frames + self._menu.bad_lines + self._lines.bad_lines
        counts["bytes"] += self._camera.bytes
        counts["unanswered"] = sum(port.opened_at is not None and not port.is_up for port in self._all_ports().values())
        return counts

    # -- to the dog -------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._ports["main"].open()
        self._watch_at = self._clock.seconds()
        self._on_watch()

    def _close(self) -> Deferred[None]:
        self._again.cancel()
        self._watch.cancel()
        self._ports["estop"].send(b"stop\n")
        self._tell(menu.stopped(sorted(self._started)))
        closing = [port.close() for port in self._ports.values()] + [self._camera.close()]
        return gatherResults(closing).addCallback(lambda _: None)

    def _power(self, on: bool) -> None:
        if not on:
            self._halt()
        # A switch that stands so already says nothing by itself.
        self._ports["estop"].send(b"start\nrefresh\n" if on else b"stop\nrefresh\n")

    def _drive(self, motion: Action, permit: Permit) -> Action:
        forward, backward, aside, turn = self._options.speed
        vx, vy, wz = motion["base.vx"], motion["base.vy"], motion["base.wz"]
        r = wz / turn
        # All three at full scale ruin the gait: what turning leaves is there for walking.
        left = 1.0 - abs(r)
        f = min(max(vx / (forward if vx > 0 else backward), -left), left)
        s = min(max(vy / aside, -left), left)
        self._say_walk(f, s, r)
        if abs(f) * (forward if f > 0 else backward) < abs(vx):
            vx = f * (forward if f > 0 else backward)
        if abs(s) * aside < abs(vy):
            vy = s * aside
        return {"base.vx": vx, "base.vy": vy, "base.wz": wz}

    def _halt(self) -> None:
        self._say_walk(0.0, 0.0, 0.0)

    def _last_word(self) -> LastWord | None:
        link = self._ports["walk"].link
        return None if link is None else LastWord(_walking(0.0, 0.0, 0.0), link)

    def _say_walk(self, f: float, s: float, r: float) -> None:
        self._again.cancel()
        self._walk = (f, s, r)
        self._ports["walk"].send(_walking(f, s, r))
        if any(self._walk):
            self._again.set(AGAIN_S, self._on_again)

    def _on_again(self) -> None:
        if self._may_move:
            self._say_walk(*self._walk)
        else:
            self.stop()

    def _start_lines(self, services: list[str]) -> list[str]:
        return menu.started(services, self._options.camera_transport, self._fps, self._options.camera_width)

    def _tell(self, lines: list[str]) -> None:
        if lines:
            self._ports["main"].send("".join(line + "\n" for line in lines).encode("ascii"))

    def _look(self, arguments: Mapping[str, float | str]) -> dict[str, Value]:
        done: dict[str, Value] = {}
        said = b""
        for key, value in arguments.items():
            if key not in _HEAD or isinstance(value, (bool, str)) or not -10.0 < value < 10.0:
                raise Unsupported(f"look knows pan, tilt and nod in radians, not {key} = {value!r}")
            letter, (low, high) = _HEAD[key]
            angle = min(max(float(value), low), high)
            said += command(letter, angle / high if angle > 0 else -angle / low if angle < 0 else 0.0)
            done[f"ptz.{key}"] = angle
        port = self._need("head")
        if self._is_engaged:
            raise NotEnabled(f"{self._name}'s motors are off; call enable() first")
        port.send(said)
        return done

    def _play(self, arguments: Mapping[str, float | str]) -> dict[str, Value]:
        name = arguments.get("sound")
        if len(arguments) != 1 or not isinstance(name, str) or not ANY_SOUND.fullmatch(name):
            raise Unsupported('play takes the name of a sound file on the stick, as in sound = "mew.wav"')
        self._need("main")
        self._tell(menu.sound(name))
        return {}

    def _need(self, service: str) -> Port:
        port = self._ports[service]
        if self._is_closed or not port.is_up:
            raise LinkLost(f"{self._name} has no link to its {service} server at the moment; it is being opened")
        return port

    # -- from the dog -----------------------------------------------------------------------------------------------

    def _port(self, service: str, on_up: Callable[[], None], on_bytes: Callable[[bytes], None]) -> Port:
        def received(data: bytes) -> None:
            self._counts["bytes"] += len(data)
            on_bytes(data)

        address = (self._options.host, self._options.ports[service])
        return Port(self._connector, self._clock, address, on_up, partial(self._on_lost, service), received)

    def _all_ports(self) -> dict[str, Port]:
        return {**self._ports, "camera": self._camera.port}

    def _on_main_up(self) -> None:
        self._counts["bad_frames"] += self._menu.bad_lines
        self._menu, self._hellos, self._main_at = MenuReader(), 0, self._clock.seconds()
        services = [service for service in menu.SERVERS if service != "camera" or self._fps > 0]
        self._tell(menu.greeting() + self._start_lines(services))

    def _on_main(self, data: bytes) -> None:
        for message in self._menu.read(data):
            if isinstance(message, Hello):
                self._hellos += 1
                if self._hellos == 2:
                    self._open_ports()
            elif isinstance(message, Load):
                self._on_load(message.port)

    def _on_load(self, number: int) -> None:
        for service, port in self._all_ports().items():
            if port.number == number:
                self._started.add(service)
                if port.opened_at is not None:
                    port.open()

    def _open_ports(self) -> None:
        """The servers run by now, or never will: call them, those that wait for another try as well."""
        self._main_at = None
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
                    self.log.warn("{robot}: somebody pressed its switch; the motors are off", robot=self._name)
                    self._wants_motors = None
                    self.stop()
                self._is_engaged = True
            elif line == "off":
                self._is_engaged = self._wants_motors is not True
                if self._is_engaged:
                    # Its switch was pressed twice again; whoever is to move it says so here.
                    self._ports["estop"].send(b"stop\n")
            else:
                self._counts["bad_frames"] += 1

    def _on_state_up(self) -> None:
        self._states = StateReader()
        self._heard_at = self._clock.seconds()
        self._odometry.forget()
        self._frame = None
        self._check_up()

    def _on_state(self, data: bytes) -> None:
        try:
            for state in self._states.read(data):
                self._on_world(state)
        except BadFrame as error:
            # Nothing marks the next packet: only a new link begins with one.
            self._counts["bad_frames"] += 1
            self._name_once("state", f"what port {self._ports['state'].number} says is no world state: {error}")
            self._ports["state"].drop()

    def _on_world(self, state: WorldState) -> None:
        values: dict[str, Value] = {}
        if sense.is_known(state):
            try:
                values = sense.values(state)
            except BadFrame as error:
                self._counts["bad_frames"] += 1
                self._name_once("sense", f"a world state was dropped: {error}")
                return
        else:
            self._name_once("model", f"its model {state.model!r} is none whose sensors are known here")
        self._counts["frames"] += 1
        self._heard_at = self._clock.seconds()
        self._named -= {"silence", "state"}
        forward, backward, aside, turn = self._options.speed
        f, s, r = (0.0, 0.0, 0.0) if self._is_engaged else self._walk
        motion = (f * (forward if f > 0 else backward), s * aside, r * turn)
        self._odometry.step(state.t, *motion)
        values.update(zip(("base.vx", "base.vy", "base.wz"), motion, strict=True))
        values |= {"base.moving": any(motion), ENGAGED: self._is_engaged, "mode": state.dialect}
        if self._is_up:
            self._observed({**values, **self._odometry.values()}, self._odometry.t, frame=self._frame)

    def _on_picture(self, picture: Picture) -> None:
        self._counts["pictures"] += 1
        size = (picture.width, picture.height)
        t = self._odometry.moment(picture.t)
        self._frame = Frame(picture.number, *size, picture.data, t, picture.encoding)

    def _check_up(self) -> None:
        if self._is_up or self._is_closed or not all(self._ports[service].is_up for service in NEEDED):
            return
        self._heard_at = self._clock.seconds()
        self._halt()
        if not self._wants_motors:
            self._power(False)
        # That it says nothing, or rubbish, is said again only when it has spoken in between.
        self._named &= {"silence", "sense", "state"}
        self._up()

    def _on_lost(self, service: str) -> None:
        if service in NEEDED and self._is_up:
            self._halt()
            self._down()

    def _on_watch(self) -> None:
        now = self._clock.seconds()
        self._heard_at = heard_at(self._heard_at, self._watch_at, now)
        self._watch_at = now + WATCH_S
        self._watch.set(WATCH_S, self._on_watch)
        if self._main_at is not None and now - self._main_at > STARTED_S and self._ports["main"].is_up:
            self._name_once("main", "main control does not answer; its ports are tried all the same")
            self._open_ports()
        if self._ports["state"].is_up and now - self._heard_at > self.STALE_S:
            self._heard_at = now
            self._name_once("silence", f"no world state for {self.STALE_S:g} s; the link is opened again")
            self._ports["state"].drop()
            # A dog that was switched off and on has to be asked for its servers again.
            self._ports["main"].drop()
        if self._camera.is_silent and self._ports["main"].is_up:
            self._ask_again("camera", 0.0)
        for service, port in self._all_ports().items():
            if port.is_up or port.opened_at is None:
                continue
            if service != "main":
                self._ask_again(service, port.opened_at)
            if now - port.opened_at > PATIENCE_S:
                where = f"{self._options.host}:{port.number}"
                why = "is it on, and does no other client hold the port (the dog takes one)?"
                self._name_once(service, f"its {service} server at {where} does not answer; {why}")

    def _ask_again(self, service: str, since: float) -> None:
        """Have main control start a server that is silent for a while: one of Tekkotsu 5 ends with its client."""
        now = self._clock.seconds()
        if now - max(since, self._asked_at.get(service, 0.0)) > ASK_S:
            self._asked_at[service] = now
            self._tell([select(name) for name in menu.SERVERS[service]])

    def _name_once(self, what: str, problem: str) -> None:
        if what not in self._named:
            self._named.add(what)
            self.log.warn("{robot}: {problem}", robot=self._name, problem=problem)


def _walking(f: float, s: float, r: float) -> bytes:
    return command("f", f) + command("s", s) + command("r", r)


_HEAD = {"pan": ("p", sense.PAN), "tilt": ("t", sense.TILT), "nod": ("r", sense.NOD)}
"""The letter of each axis, and how far it goes."""


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> AiboDriver:
    """A driver of the dog at the host that ``options`` name."""
    return AiboDriver(
        checked(options),
        name,
        TcpConnector(waits=WAITS) if connector is None else connector,
        clock,
        UdpDatagrams(clock),
        kept(name) if connector is None else None,
    )


def describe(options: Mapping[str, object], name: str) -> Description:
    """What that dog is."""
    return described(checked(options))
