"""Measure the simultaneous driving of three AIBOs over their own protocol.

``make bench-robots`` starts a simulator that emulates three robots, and for each robot a process that only drives it.
It prints the regularity of world states and pictures, the time of a command from the driver's ``act`` to the legs, and
the processor time and memory of each driver. Linux only: the figures come from ``/proc``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

from benchmarks.measure import MIB, read_cpu_s, read_memory_bytes
from drivers.reading import Observation

DOGS = 3
AIBO_SERVICES = ("main", "estop", "state", "walk", "head", "camera")
START_LIMIT_S = 30.0
COMMAND_INTERVAL_S = 0.1
TARGETS = {"frame_s": 0.032, "late_s": 0.020, "fps": 30.0, "wheel_ms": 20.0, "core": 0.05, "rss_mib": 45.0}
"""Seconds between world states and the delay of 95 of 100, pictures a second, and the limits of a driver."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robots", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="duration of each of the two parts (default %(default)s)"
    )
    parser.add_argument("--yard", help=argparse.SUPPRESS)
    parser.add_argument("--drive", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.seconds < 2:
        parser.error("--seconds must be 2 or more")
    if args.yard:
        return _emulate(json.loads(args.yard))
    if args.drive:
        return _drive(json.loads(args.drive), args.seconds)
    return _measure(args.seconds)


# -- the robots ---------------------------------------------------------------------------------------------------


def _emulate(ports: list[dict[str, int]]) -> int:
    """Emulate three robots; at the end print each motion that reached the legs: robot, forward velocity, time."""
    from random import Random

    from twisted.internet import reactor as running

    from sim.robots.dog import LIMITS
    from sim.robots.emulator.aibo import AiboServer
    from sim.robots.emulator.aibo_dog import AiboEmulator
    from sim.robots.scene import load_scene
    from sim.robots.simulator import RobotSimulator

    reactor: Any = running
    simulator = RobotSimulator(reactor, Random(1), load_scene("three-dogs"))
    # The output is read at the end only, and a full pipe would block the simulator.
    legs: list[tuple[int, float, float]] = []
    for number, served in enumerate(ports):
        body: Any = simulator.reserve_for_emulator(f"dog{number + 1}", LIMITS)
        drive = body.drive

        def stamped(vx: float, vy: float, wz: float, number: int = number, drive: Any = drive) -> None:
            legs.append((number, vx, time.monotonic()))
            # The robot does not move on the map, because its position is not needed; only the command is recorded.
            drive(0.0, 0.0, 0.0)

        body.drive = stamped
        AiboServer(reactor, AiboEmulator(reactor, body, Random(number), ports={**served, "gains": 0})).start()
    simulator.start()
    reactor.callWhenRunning(print, "ready", flush=True)
    reactor.run()
    for dog, vx, at in legs:
        print(dog, f"{vx:.9f}", at)
    return 0


# -- one driver ---------------------------------------------------------------------------------------------------


class DriverProcess:
    """A driver process that sends a command each ``COMMAND_INTERVAL_S`` and records the times of received data."""

    def __init__(self, reactor: Any, options: dict[str, Any], seconds: float) -> None:
        from drivers.registry import create_driver

        self._reactor = reactor
        self._seconds = seconds
        self._driver: Any = create_driver("aibo", options, "dog", reactor)
        self._frames: list[float] = []
        self._pictures: set[int] = set()
        self._commands: list[tuple[float, float]] = []
        self._count = 0
        self._ends_at = 0.0
        self._before = (0.0, 0.0)

    def start(self) -> None:
        """Connect, enable, and start the measurement when data arrives."""
        self._driver.connect().addCallback(lambda _: self._driver.enable()).addCallback(
            lambda _: self._reactor.callLater(2.0, self._begin)
        )

    def _begin(self) -> None:
        self._ends_at = self._reactor.seconds() + self._seconds
        self._before = (time.monotonic(), read_cpu_s(os.getpid()))
        self._driver.subscribe(self._on_observation)
        self._command()

    def _on_observation(self, seen: Observation) -> None:
        self._frames.append(time.monotonic())
        if seen.frame is not None:
            self._pictures.add(seen.frame.seq)

    def _command(self) -> None:
        from drivers.driver import Permit

        now = self._reactor.seconds()
        if now >= self._ends_at:
            return self._write_report()
        self._count += 1
        # Each command has a unique velocity, by which it is recognised.
        vx = 0.05 + (self._count % 1000) * 1e-5
        self._commands.append((vx, time.monotonic()))
        self._driver.act({"base.vx": vx}, Permit(1, now + 0.5))
        self._reactor.callLater(COMMAND_INTERVAL_S, self._command)

    def _write_report(self) -> None:
        began, spent = self._before
        elapsed = time.monotonic() - began
        told = {
            "frames": self._frames,
            "pictures": len(self._pictures) / elapsed,
            "commands": self._commands,
            "core": (read_cpu_s(os.getpid()) - spent) / elapsed,
            "rss_mib": read_memory_bytes() / MIB,
            "bad": self._driver.diagnostics()["bad_frames"],
        }
        print(json.dumps(told), flush=True)
        self._driver.disconnect().addBoth(lambda _: self._reactor.stop())


def _drive(options: dict[str, Any], seconds: float) -> int:
    # Prevent Twisted from loading pyOpenSSL (13 MiB); this process uses no TLS.
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]
    from twisted.internet import reactor

    DriverProcess(reactor, options, seconds).start()
    reactor.run()
    return 0


# -- all processes ------------------------------------------------------------------------------------------------


def _measure(seconds: float) -> int:
    from sim.demo.free_ports import find_free_ports

    numbers = iter(find_free_ports("tcp", "127.0.0.1", DOGS * len(AIBO_SERVICES)))
    ports = [{service: next(numbers) for service in AIBO_SERVICES} for _ in range(DOGS)]
    module = [sys.executable, "-m", "benchmarks.robots"]
    yard = subprocess.Popen([*module, "--yard", json.dumps(ports)], stdout=subprocess.PIPE, text=True)
    assert yard.stdout is not None
    drivers: list[subprocess.Popen[str]] = []
    try:
        if yard.stdout.readline().strip() != "ready":
            raise SystemExit("bench-robots: the robot simulator did not start")
        parts = {}
        spent = read_cpu_s(yard.pid)
        started_at = time.monotonic()
        for part, fps in (("30 pictures a second", 30.0), ("no camera", 0.0)):
            drivers.clear()
            for served in ports:
                options = json.dumps({"host": "127.0.0.1", "ports": served, "camera_fps": fps, "camera": fps > 0})
                command = [*module, "--seconds", str(seconds), "--drive", options]
                drivers.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            parts[part] = [json.loads(one.communicate(timeout=seconds + START_LIMIT_S)[0]) for one in drivers]
        share = (read_cpu_s(yard.pid) - spent) / (time.monotonic() - started_at)
    finally:
        for one in drivers:
            one.kill()
        yard.terminate()
        told, _ = yard.communicate()
    return _report(parts, [line.split() for line in told.splitlines()], share)


def _report(parts: dict[str, list[dict[str, Any]]], legs: list[list[str]], share: float) -> int:
    held = True
    print(f"{'':22} dog  frames/s  p95 ms  max ms  pictures/s    core  RSS MiB  bad")
    waits: list[float] = []
    for part, dogs in parts.items():
        for number, dog in enumerate(dogs):
            frames = dog["frames"]
            gaps = sorted(b - a for a, b in zip(frames, frames[1:], strict=False))
            rate = (len(frames) - 1) / (frames[-1] - frames[0])
            p95 = gaps[int(0.95 * len(gaps))]
            row = f"{rate:10.2f}{p95 * 1e3:8.1f}{gaps[-1] * 1e3:8.1f}{dog['pictures']:12.2f}{dog['core']:8.3f}"
            print(f"{part:22}{number + 1:4}{row}{dog['rss_mib']:9.1f}{dog['bad']:5.0f}")
            waits += _measure_delays(dog["commands"], [line for line in legs if line[0] == str(number)])
            is_even = rate >= 0.98 / TARGETS["frame_s"] and p95 <= TARGETS["frame_s"] + TARGETS["late_s"]
            has_camera = part != "no camera"
            held &= is_even and not dog["bad"]
            if has_camera:
                held &= dog["pictures"] >= 0.98 * TARGETS["fps"]
            else:
                held &= dog["core"] <= TARGETS["core"] and dog["rss_mib"] <= TARGETS["rss_mib"]
    waits.sort()
    p50, p95, most = (1e3 * waits[int(part * (len(waits) - 1))] for part in (0.5, 0.95, 1.0))
    held &= p95 <= TARGETS["wheel_ms"]
    print(f"command to wheel: p50 {p50:.2f} ms, p95 {p95:.2f} ms, max {most:.1f} ms, of {len(waits)}")
    print(f"simulator with all three: {share:.2f} of a core")
    print(
        "targets: a world state each 32 ms, 95 of 100 at most 20 ms late; 30 pictures a second; "
        "command to wheel p95 at most 20 ms; "
        f"without camera 0.05 of a core and 45 MiB: {'held' if held else 'MISSED'}"
    )
    return 0 if held else 1


def _measure_delays(commands: list[list[float]], legs: list[list[str]]) -> list[float]:
    """Return the seconds from each command to the first motion of the legs with its velocity."""
    found = []
    place = 0
    for vx, at in commands:
        while place < len(legs) and (float(legs[place][2]) < at or abs(float(legs[place][1]) - vx) > 2e-6):
            place += 1
        if place < len(legs):
            found.append(float(legs[place][2]) - at)
    return found


if __name__ == "__main__":
    sys.exit(main())
