"""Prepare the folder and the ports of a demonstration before its processes start."""

from __future__ import annotations

import fcntl
import secrets
import shutil
import sys
from collections.abc import Callable
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TextIO

from sim.demo import free_ports
from sim.demo.configuration import BOOTSTRAP, DOGS, RESERVE, Plan
from sim.demo.robots import LOOPBACK, MAX_PORTS, make_robots

WEB_PORT, TLS_PORT, NODE_PORT, SIMULATOR_PORT = 8080, 8443, 7000, 7400
SERVER_PORTS = 5
"""Number of ports for the two pages, both over TLS, and the simulator."""
ANY_ADDRESS = "0.0.0.0"
MARKER_FILE = ".swarm-demo"
CODE_LETTERS = "abcdefghjkmnpqrstuvwxyz"
"""Letters of a sign-in code; no letter resembles another letter or a digit."""


class DemoError(Exception):
    """The demonstration cannot continue; the message is for the person who started it."""


def lock_run_dir(run_dir: Path) -> TextIO:
    """Create or empty ``run_dir`` and lock it; return the lock, which is held until it is closed.

    Refuses a folder that contains anything other than an earlier demonstration.
    """
    mark = run_dir / MARKER_FILE
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        if not mark.exists() and any(run_dir.iterdir()):
            raise DemoError(f"{run_dir} is not empty and not from an earlier demonstration; choose another --run-dir")
        lock = mark.open("a", encoding="utf-8")
    except OSError as error:
        raise DemoError(f"cannot use {run_dir} ({error.strerror}); choose another --run-dir") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise DemoError(f"another demonstration runs in {run_dir}; end it, or choose another --run-dir") from None
    for entry in run_dir.iterdir():
        if entry.name == MARKER_FILE:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    return lock


def print_line(line: str) -> None:
    """Print a line and flush."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def has_tls() -> bool:
    """Return whether nodes of this installation can serve TLS, even if this process blocks the import of OpenSSL."""
    return all(PathFinder.find_spec(name) is not None for name in ("OpenSSL", "cryptography"))


def make_plan(
    run_dir: Path,
    web_host: str,
    web_port: int | None,
    usual: bool,
    say: Callable[[str], None],
    with_tls: bool = False,
    robot: str = "sim",
) -> Plan:
    """Return a plan with free ports; report each usual port that is busy.

    With ``usual`` the usual ports are tried first, for interactive use; otherwise arbitrary ports are used, so that
    several demonstrations can start at the same time. With ``with_tls`` the pages are also served over TLS. ``robot``
    is a key of ``sim.demo.robots.ROBOT_SETS``.
    """
    try:
        free_ports.check_host("tcp", web_host)
    except OSError as error:
        remedy = "set --web-host to an address of this machine, or 0.0.0.0 for all of them"
        raise DemoError(f"cannot serve the page on {web_host} ({error.strerror}); {remedy}") from error
    # The ports must be free on every address, because page and robots may use different addresses.  The port that the
    # operator requested is not used for another purpose.
    found = free_ports.find_free_ports("tcp", ANY_ADDRESS, 1 + SERVER_PORTS + MAX_PORTS * len(DOGS))
    spare = iter([one for one in found if one != web_port])
    if web_port:
        web = free_ports.require_port("tcp", web_host, web_port, "the page")
    else:
        web = free_ports.choose_port("tcp", web_host, WEB_PORT if usual else 0, spare)
    reserve = free_ports.choose_port("tcp", web_host, web + 1 if usual and web < 65535 else 0, spare)
    tls = (0, 0)
    if with_tls:
        # The ports of the pages are not bound yet, so they would be found as free.
        preferred_port = TLS_PORT if usual and not {TLS_PORT, TLS_PORT + 1} & {web, reserve} else 0
        first = free_ports.choose_port("tcp", web_host, preferred_port, spare)
        tls = (first, free_ports.choose_port("tcp", web_host, first + 1 if first == preferred_port else 0, spare))
    simulator_port = free_ports.choose_port("tcp", LOOPBACK, SIMULATOR_PORT if usual else 0, spare)
    quiet = iter(free_ports.find_free_ports("udp", LOOPBACK, 2 + len(DOGS)))
    node = free_ports.choose_port("udp", LOOPBACK, NODE_PORT if usual else 0, quiet)
    others = [next(quiet) for _ in (RESERVE, *DOGS)]
    if usual:
        wanted = [
            ("the page", web_port or WEB_PORT, web),
            ("the yard", SIMULATOR_PORT, simulator_port),
            ("vaio", NODE_PORT, node),
        ]
        wanted += [("the page over TLS", TLS_PORT, tls[0])] if with_tls else []
        for what, preferred_port, got in wanted:
            if preferred_port != got:
                say(f"port {preferred_port} is busy; {what} uses {got}")
    nodes = {BOOTSTRAP: node, **dict(zip((RESERVE, *DOGS), others, strict=True))}
    code = "".join(secrets.choice(CODE_LETTERS) for _ in range(8))
    robots = make_robots(robot, DOGS, run_dir, spare, simulator_port)
    return Plan(run_dir, web_host, web, simulator_port, nodes, f"{code[:4]}-{code[4:]}", reserve, tls, robots)
