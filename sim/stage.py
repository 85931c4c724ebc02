"""Stage: the folder and the ports of a demonstration, taken before anything starts."""

from __future__ import annotations

import fcntl
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from sim import port
from sim.configuration import BOOTSTRAP, DOGS, LOOPBACK, Plan

WEB_PORT, NODE_PORT, YARD_PORT = 8080, 7000, 7400
MARK = ".swarm-demo"


class Trouble(Exception):
    """The demonstration cannot go on; the message is for the person who started it."""


def fresh(run_dir: Path) -> TextIO:
    """Make ``run_dir`` empty and ours; returns the open lock, which is held for as long as that stays open.

    Refuses a folder that holds anything but an earlier demonstration.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    mark = run_dir / MARK
    if not mark.exists() and any(run_dir.iterdir()):
        raise Trouble(f"{run_dir} is not empty and no earlier demonstration; choose another --run-dir")
    lock = mark.open("a", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise Trouble(f"another demonstration runs in {run_dir}; end it, or choose another --run-dir") from None
    for entry in run_dir.iterdir():
        if entry.name == MARK:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    return lock


def arranged(run_dir: Path, web_host: str, web_port: int | None, say: Callable[[str], None]) -> Plan:
    """A plan on ports that are free; a port that had to give way is said."""
    web = port.chosen("tcp", web_host, web_port, "the page") if web_port else port.preferred("tcp", web_host, WEB_PORT)
    yard = port.preferred("tcp", LOOPBACK, YARD_PORT)
    node = port.preferred("udp", LOOPBACK, NODE_PORT)
    for what, usual, got in (("the page", web_port or WEB_PORT, web), ("the yard", YARD_PORT, yard)):
        if usual != got:
            say(f"port {usual} is busy; {what} uses {got}")
    if node != NODE_PORT:
        say(f"port {NODE_PORT} is busy; the bootstrap node uses {node}")
    nodes = {BOOTSTRAP: node, **dict(zip(DOGS, port.free("udp", LOOPBACK, len(DOGS)), strict=True))}
    return Plan(run_dir, secrets.token_hex(32), web_host, web, yard, nodes)
