"""The robot simulator as a process behind one TCP port: ``python -m sim.robots.server``."""

from __future__ import annotations

import argparse
import errno
import sys
import time
import tomllib
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, TextIO

from twisted.internet.base import ReactorBase
from twisted.internet.error import CannotListenError
from twisted.logger import (
    FilteringLogObserver,
    LogLevel,
    LogLevelFilterPredicate,
    globalLogBeginner,
    textFileLogObserver,
)

from drivers.errors import UsageError
from drivers.link import TcpLinkFactory
from drivers.sim.option import DEFAULT_PORT
from sim.robots.scene import SceneError, load_scene
from sim.robots.simulator import RobotSimulator

EXIT_USAGE = 2


def main(arguments: list[str] | None = None, output: TextIO = sys.stdout, errors: TextIO = sys.stderr) -> int:
    """Run a simulator until it is interrupted; return the exit code: 0, or 2 after an error message of one line."""
    parser = argparse.ArgumentParser(
        prog="swarm simulator",
        description='Simulate robot dogs for the driver "sim" and for emulators.  Example: swarm simulator --seed 7',
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    parser.add_argument(
        "--port", type=int, default=DEFAULT_PORT, help="TCP port, 0: any free port (default %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the random generator (default %(default)s)")
    parser.add_argument("--scene", default="three-dogs", help="a scene's name or a .json file (default %(default)s)")
    parser.add_argument(
        "--robots",
        type=Path,
        metavar="FILE",
        help="a TOML file with the driver settings of each dog that emulates another kind of robot "
        "(docs/how-to/simulate-robots.md)",
    )
    args = parser.parse_args(arguments)
    if not 0 <= args.port <= 65535:
        return _print_error(errors, f"port {args.port} is invalid; choose one from 1 to 65535, or 0 for any")
    try:
        scene = load_scene(args.scene)
        table = _read_table(args.robots)
    except (SceneError, UsageError) as error:
        return _print_error(errors, str(error))
    # By default Twisted's timers use the wall clock, whose steps would freeze or race the simulation. The clock used
    # here also counts suspended time, so old commands have expired when the machine resumes.
    ReactorBase.seconds = staticmethod(
        partial(time.clock_gettime, time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic
    )
    # Prevent Twisted from importing pyOpenSSL (13 MiB); the simulator has no TLS.
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]
    from twisted.internet import reactor as running

    reactor: Any = running
    warnings = LogLevelFilterPredicate(defaultLogLevel=LogLevel.warn)
    globalLogBeginner.beginLoggingTo(
        [FilteringLogObserver(textFileLogObserver(errors), [warnings])], redirectStandardIO=False
    )
    simulator = RobotSimulator(reactor, Random(args.seed), scene)
    try:
        robots = _make_emulators(reactor, args.seed, simulator, table)
    except UsageError as error:
        return _print_error(errors, f"{args.robots}: {error}")
    try:
        port = reactor.listenTCP(args.port, TcpLinkFactory(simulator.attach), interface=args.host)
    except CannotListenError as error:
        why: OSError = error.socketError
        is_taken = why.errno in (errno.EADDRINUSE, errno.EACCES)
        remedy = "try another --port" if is_taken else "give --host an address of this machine"
        return _print_error(errors, f"cannot listen on {args.host}:{args.port}: {why.strerror or why}; {remedy}")
    address = port.getHost()
    try:
        if robots is not None:
            robots.start()
            reactor.addSystemEventTrigger("before", "shutdown", robots.stop)
    except UsageError as error:
        robots.stop()
        return _print_error(errors, f"{args.robots}: {error}")
    simulator.start()
    reactor.addSystemEventTrigger("before", "shutdown", simulator.stop)
    dogs = ", ".join(simulator.world.dogs)
    line = f"yard {scene.name} ready on {address.host}:{address.port}: {dogs}"
    # Print this line after the signal handlers are installed: its reader may end the process immediately.
    reactor.callWhenRunning(print, line, file=output, flush=True)
    reactor.run()
    return 0


def _read_table(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"--robots {path}: {error}") from None
    return table


def _make_emulators(reactor: Any, seed: int, simulator: RobotSimulator, table: dict[str, Any]) -> Any:
    """Return the emulators of ``table``; for an empty table the modules are not imported, to save memory."""
    if not table:
        return None
    from sim.robots.emulated_robots import EmulatedRobots

    return EmulatedRobots(reactor, Random(seed), simulator, table)


def _print_error(errors: TextIO, problem: str) -> int:
    print(f"swarm simulator: {problem}", file=errors)
    return EXIT_USAGE


if __name__ == "__main__":
    sys.exit(main())
