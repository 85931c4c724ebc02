"""Driver of a Create 2 or Roomba on a serial cable.

The robot has no time-out: it drives until the next command, or until its own cliff and wheel-drop sensors stop it. The
driver therefore ends each motion at its deadline; if this process freezes, a dead man's switch ends the motion. If the
cable is unplugged during a motion, the robot cannot be stopped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.base import LinkedDriver, correct_last_data_time
from drivers.create2 import codec
from drivers.create2.odometry import WHEEL_BASE_MM, Odometry
from drivers.create2.option import SKILLS, Options, make_description, parse_options
from drivers.create2.sensors import DRIVING_MODES, PACKET_IDS, convert_frame, describe_safety_event, get_mode
from drivers.deadman.supervisor import create_switch
from drivers.deadman.switch import DeadManSwitch, HaltCommand
from drivers.driver import Permit
from drivers.errors import LinkLost, NoReply, NotEnabled, Unsupported, UsageError
from drivers.link import Connector, Link
from drivers.option import Manifest
from drivers.reading import Action, Description, Value
from drivers.serial import SerialConnector
from drivers.timer import Timer

MANIFEST = Manifest("serial", "serial", example={"port": "/dev/ttyUSB0"}, is_on_cable=True)

START_DELAY_S = 0.05
"""Seconds to wait after ``START`` before the next command."""
SILENCE_S = 0.5
"""Seconds without a frame after which ``START`` is sent again: the robot was switched off, or rebooted."""
MAX_SILENCE_S = 4.0
DOCK_TIMEOUT_S = 120.0
"""Seconds within which the robot must find its home base."""


class Create2Driver(LinkedDriver):
    """One robot on a serial device.

    ``enable`` selects safe (or full) mode, ``disable`` passive mode.  If the robot leaves safe mode by itself (at a
    cliff, a lifted wheel or a charger), that is a safety event: ``safety.event`` contains the reason, the motion is
    zero, and the motors stay off until ``enable`` is called again.
    """

    def __init__(
        self,
        options: Options,
        name: str,
        connector: Connector,
        clock: IReactorTime,
        dead_man: DeadManSwitch | None = None,
    ) -> None:
        super().__init__(make_description(options), name, clock, connector, (options.port, options.baud), dead_man)
        self._options = options
        self._reader: codec.StreamReader = codec.StreamReader(PACKET_IDS)
        self._odometry = Odometry()
        self._silence_s = SILENCE_S
        self._last_data_at = self._next_check_at = 0.0
        self._bytes_at_start = 0
        self._mode = ""
        self._safety_event = ""
        self._docking: Deferred[Mapping[str, Value]] | None = None
        self._dock_timer = Timer(clock)
        self._counts |= {"safety_events": 0, "jumps": 0}

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Run ``dock`` (drive to the home base) or ``beep`` (play ``hz``, from 49 to 12544, for ``s`` seconds)."""
        if name not in SKILLS:
            return super().invoke(name, **arguments)
        if not self._is_up or self.state in ("stale", "closed"):
            return fail(LinkLost(f"{self._name} is {self.state}; connect first, or wait for the link"))
        try:
            return self._dock(arguments) if name == "dock" else self._beep(arguments)
        except UsageError as error:
            return fail(error)

    # -- to the robot -----------------------------------------------------------------------------------------------

    def _close(self) -> Deferred[None]:
        self._end_docking(LinkLost(f"{self._name}: disconnected"))
        # If it gets no STOP, the robot stays awake and drains its battery.
        self._send(codec.encode_drive_direct(0, 0) + codec.encode_pause(False) + bytes((codec.START, codec.STOP)))
        return super()._close()

    def _power(self, on: bool) -> None:
        self._end_docking(NotEnabled("enable() or disable() ended the search for the dock"))
        if on:
            self._safety_event = ""
            self._send(bytes((codec.SAFE if self._options.mode == "safe" else codec.FULL,)))
        else:
            self._send(codec.encode_drive_direct(0, 0) + bytes((codec.START,)))

    def _drive(self, motion: Action, permit: Permit) -> Action:
        ahead, turn = motion["base.vx"] * 1000.0, motion["base.wz"] * WHEEL_BASE_MM / 2.0
        right, left = ahead + turn, ahead - turn
        share = min(1.0, codec.MAX_WHEEL_SPEED_MMPS / max(abs(right), abs(left), 1.0))
        right, left = round(right * share), round(left * share)
        self._send(codec.encode_drive_direct(right, left))
        return {"base.vx": (right + left) / 2000.0, "base.wz": (right - left) / WHEEL_BASE_MM}

    def _halt(self) -> None:
        if not self._end_docking(NotEnabled("stop() ended the search for the dock")):
            self._send(codec.encode_drive_direct(0, 0))

    def _make_halt_command(self) -> HaltCommand | None:
        return None if self._link is None else HaltCommand(codec.encode_drive_direct(0, 0), self._link)

    def _dock(self, arguments: Mapping[str, float | str]) -> Deferred[Mapping[str, Value]]:
        if arguments:
            raise Unsupported("dock takes no arguments")
        if self._docking is not None:
            raise UsageError("{self._name} is already seeking its dock")
        if self._wants_motors is not True or self._mode not in DRIVING_MODES:
            raise NotEnabled(f"{self._name}'s motors are off; call enable() first")
        self.stop()
        # The robot drives itself in passive mode; this change of mode is not a safety event.
        self._wants_motors = False
        self._docking = Deferred(self._on_docking_cancelled)
        late = NoReply(f"{self._name} did not find its dock within {DOCK_TIMEOUT_S:g} s")
        self._dock_timer.set(DOCK_TIMEOUT_S, self._end_docking, late)
        self._send(bytes((codec.DOCK,)))
        return self._docking

    def _on_docking_cancelled(self, _docking: object) -> None:
        self._end_docking(None)

    def _on_docked(self) -> None:
        docking, self._docking = self._docking, None
        self._dock_timer.cancel()
        if docking is not None:
            docking.callback({"dock.on": True})

    def _end_docking(self, error: Exception | None) -> bool:
        """End the search for the dock: the robot stands still, in passive mode; return whether it was searching."""
        docking, self._docking = self._docking, None
        if docking is None:
            return False
        self._dock_timer.cancel()
        # The robot ignores wheel commands while it docks: switch to safe mode, stop, and return to passive mode.
        self._send(bytes((codec.SAFE,)) + codec.encode_drive_direct(0, 0) + bytes((codec.START,)))
        if error is not None:
            docking.errback(error)
        return True

    def _beep(self, arguments: Mapping[str, float | str]) -> Deferred[Mapping[str, Value]]:
        unknown = sorted(set(arguments) - {"hz", "s"})
        if unknown:
            raise Unsupported(f"beep has no argument {unknown[0]!r}; its arguments are hz and s")
        hz, seconds = arguments.get("hz", 440.0), arguments.get("s", 0.5)
        if not _is_between(hz, 49.0, 12544.0) or not _is_between(seconds, 1 / 64, 3.98):
            raise Unsupported("beep needs hz from 49 to 12544 and s from 0.016 to 3.98")
        if self._mode not in DRIVING_MODES:
            raise NotEnabled(f"{self._name} beeps in safe or full mode only; call enable() first")
        note = min(127, round(69 + 12 * math.log2(float(hz) / 440.0)))
        self._send(codec.encode_song(0, [(note, round(float(seconds) * 64))]) + codec.encode_play(0))
        return succeed({"beep.hz": 440.0 * 2.0 ** ((note - 69) / 12)})

    # -- from the robot ---------------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Start the robot; called by the link."""
        self._link = link
        self._silence_s = SILENCE_S
        self._start()

    def link_down(self) -> None:
        """Reset the motion; the robot itself keeps driving until it is reachable again. Called by the link."""
        self._link = None
        self._timer.cancel()
        self._end_docking(LinkLost(f"the link to {self._name} was lost"))
        self._down()

    def _on_message(self, frame: Mapping[str, int]) -> None:
        self._counts["frames"] += 1
        mode, before = get_mode(frame), self._mode
        if mode in DRIVING_MODES and not self._is_up:
            return  # sent before the robot processed START, which selects passive mode
        now = self._clock.seconds()
        self._last_data_at = now
        self._silence_s = SILENCE_S
        self._problem = ""
        self._mode = mode
        if not self._is_up:
            self._up()
        self._odometry.update(frame["left_encoder"], frame["right_encoder"], now)
        self._counts["jumps"] = self._odometry.jumps
        values = convert_frame(frame)
        if before in DRIVING_MODES and mode not in DRIVING_MODES and self._wants_motors:
            self._on_safety_event(describe_safety_event(values))
        odometry = self._odometry
        values |= {"odom.x": odometry.x, "odom.y": odometry.y, "odom.yaw": odometry.yaw}
        values |= {"base.vx": odometry.vx, "base.vy": 0.0, "base.wz": odometry.wz}
        values["base.moving"] = bool(odometry.vx or odometry.wz)
        values["safety.event"] = self._safety_event
        values["skill.running"] = "" if self._docking is None else "dock"
        if self._docking is not None and values["dock.on"]:
            self._on_docked()
        # The robot sends no time stamps, so the time of arrival is used.
        self._observed(values, now)

    def _on_safety_event(self, event: str) -> None:
        self._safety_event = event
        self._counts["safety_events"] += 1
        self.stop()
        self._wants_motors = False
        self.log.warn("{robot} left {mode} mode: {event}", robot=self._name, mode=self._options.mode, event=event)

    def _start(self) -> None:
        # A robot that has received an incomplete command reads the first of these bytes as the missing data.
        self._send(bytes((codec.START,)) * 5)
        self._reader = codec.StreamReader(PACKET_IDS)
        self._odometry.discard_counts()
        self._mode = ""
        self._bytes_at_start = self._counts["bytes"]
        self._timer.set(START_DELAY_S, self._start_stream)

    def _start_stream(self) -> None:
        self._send(codec.encode_stream(PACKET_IDS))
        self._last_data_at = self._clock.seconds()
        self._schedule_check(self._silence_s)

    def _schedule_check(self, seconds: float) -> None:
        self._next_check_at = self._clock.seconds() + seconds
        self._timer.set(seconds, self._check_silence)

    def _check_silence(self) -> None:
        now = self._clock.seconds()
        self._last_data_at = correct_last_data_time(self._last_data_at, self._next_check_at, now)
        silent = now - self._last_data_at
        if silent < self._silence_s:
            self._schedule_check(self._silence_s - silent)
            return
        self._silence_s = min(2.0 * self._silence_s, MAX_SILENCE_S)
        has_noise = self._counts["bytes"] > self._bytes_at_start and not self._is_up
        self._set_problem(
            f"the device sends data, but no frames; is {self._options.baud} baud correct, and is it a Create 2?"
            if has_noise
            else "the robot sends nothing; is it switched on, and is the cable plugged in?"
        )
        self._end_docking(LinkLost(f"{self._name} does not answer"))
        if self._is_up:
            self._down()
        self._start()


def _is_between(value: float | str, low: float, high: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> Create2Driver:
    """Return a driver of the robot on the serial device in ``options``."""
    if connector is not None:
        return Create2Driver(parse_options(options), name, connector, clock)
    return Create2Driver(parse_options(options), name, SerialConnector(), clock, create_switch(name))


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the robot that ``options`` select."""
    return make_description(parse_options(options))
