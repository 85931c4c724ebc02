"""Server: the yard as a process of its own, behind one TCP port: ``python -m sim.robots.server``."""

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
from sim.robots.scene import SceneError, loaded
from sim.robots.yard import Yard

USAGE = 2


def main(arguments: list[str] | None = None, output: TextIO = sys.stdout, errors: TextIO = sys.stderr) -> int:
    """Run a yard until it is interrupted; returns the exit code: 0, or 2 with one line on what to change."""
    parser = argparse.ArgumentParser(
        prog="swarm yard", description="A yard of three dogs, reached as simulated dogs or as robots."
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help="TCP port, 0 for any (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="the same seed gives the same yard (default %(default)s)")
    parser.add_argument("--scene", default="three-dogs", help="a scene's name or a .json file (default %(default)s)")
    parser.add_argument(
        "--robots",
        type=Path,
        metavar="FILE",
        help="a TOML file: a table for each dog that is reached as a robot of another kind, as its driver has it "
        "(docs/how-to/simulate-robots.md)",
    )
    chosen = parser.parse_args(arguments)
    if not 0 <= chosen.port <= 65535:
        return _refused(errors, f"port {chosen.port} is no port; choose one from 1 to 65535, or 0 for any")
    try:
        scene = loaded(chosen.scene)
        table = _table(chosen.robots)
    except (SceneError, UsageError) as error:
        return _refused(errors, str(error))
    # Twisted's timers run on the wall clock by default: a step of that clock would freeze the yard, or race it.  What
    # was ordered before the machine was suspended must be over when it wakes.
    ReactorBase.seconds = staticmethod(
        partial(time.clock_gettime, time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic
    )
    # Twisted would load pyOpenSSL where it is installed (13 MiB); the yard speaks no TLS.
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]
    from twisted.internet import reactor as running

    reactor: Any = running
    warnings = LogLevelFilterPredicate(defaultLogLevel=LogLevel.warn)
    globalLogBeginner.beginLoggingTo(
        [FilteringLogObserver(textFileLogObserver(errors), [warnings])], redirectStandardIO=False
    )
    yard = Yard(reactor, Random(chosen.seed), scene)
    try:
        robots = _robots(reactor, chosen.seed, yard, table)
    except UsageError as error:
        return _refused(errors, f"{chosen.robots}: {error}")
    try:
        port = reactor.listenTCP(chosen.port, TcpLinkFactory(yard.attach), interface=chosen.host)
    except CannotListenError as error:
        why: OSError = error.socketError
        is_taken = why.errno in (errno.EADDRINUSE, errno.EACCES)
        remedy = "try another --port" if is_taken else "give --host an address of this machine"
        return _refused(errors, f"cannot listen on {chosen.host}:{chosen.port}: {why.strerror or why}; {remedy}")
    address = port.getHost()
    try:
        if robots is not None:
            robots.start()
            reactor.addSystemEventTrigger("before", "shutdown", robots.stop)
    except UsageError as error:
        robots.stop()
        return _refused(errors, f"{chosen.robots}: {error}")
    yard.start()
    reactor.addSystemEventTrigger("before", "shutdown", yard.stop)
    dogs = ", ".join(yard.world.dogs)
    line = f"yard {scene.name} ready on {address.host}:{address.port}: {dogs}"
    # Said only once signals are heard: who reads it may at once ask the yard to end.
    reactor.callWhenRunning(print, line, file=output, flush=True)
    reactor.run()
    return 0


def _table(path: Path | None) -> dict[str, Any]:
    """The robots in the file ``path``; raises ``UsageError`` where it is none."""
    if path is None:
        return {}
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"--robots {path}: {error}") from None
    return table


def _robots(reactor: Any, seed: int, yard: Yard, table: dict[str, Any]) -> Any:
    """What serves the robots of ``table``; a yard without any is spared the memory of their emulators."""
    if not table:
        return None
    from sim.robots.table import Robots

    return Robots(reactor, Random(seed), yard, table)


def _refused(errors: TextIO, problem: str) -> int:
    print(f"swarm yard: {problem}", file=errors)
    return USAGE


if __name__ == "__main__":
    sys.exit(main())
