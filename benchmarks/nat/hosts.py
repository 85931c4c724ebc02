"""Control the child processes on the hosts of the test network."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.remote import Lost, Remote, Unable
from sim.namespaces.internet import ROOT, Internet
from sim.namespaces.room import environment

SPAWN_S = 60.0
MARGIN_S = 10.0
"""Seconds after an order's time limit until it counts as lost."""
MAX_LINE = 1 << 20


class Computer(Remote):
    """The child process of one host, with orders that may take some time."""

    async def order(self, do: str, limit_s: float = 0.0, /, **fields: Any) -> dict[str, Any]:
        """Execute an order that may take ``limit_s``; raises ``Lost``."""
        try:
            return await super().order(do, limit_s + MARGIN_S, limit_s=limit_s, **fields)
        except Unable as error:
            raise Lost(f"{self.name} could not {do}: {error}") from None


class Hosts:
    """A child process on each of ``hosts``, during an ``async with`` block."""

    def __init__(self, net: Internet, hosts: Iterable[str], folder: Path) -> None:
        self.net = net
        self._hosts = list(hosts)
        self._folder = folder
        self._computers: dict[str, Computer] = {}

    def __getitem__(self, host: str) -> Computer:
        return self._computers[host]

    async def __aenter__(self) -> Hosts:
        try:
            for host in self._hosts:
                self._computers[host] = await self._spawn(host)
            await asyncio.gather(*(computer.up(SPAWN_S) for computer in self._computers.values()))
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(self, *trouble: object) -> None:
        await self._end()

    async def _spawn(self, host: str) -> Computer:
        said, pipe = self._folder / f"{host}.errors", asyncio.subprocess.PIPE
        command = self.net.command(host, [sys.executable, "-m", "benchmarks.nat.child"])
        with said.open("wb") as errors:
            # In a separate session, so that signals from the terminal reach only the parent.
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, stderr=errors, cwd=ROOT, env=environment(), limit=MAX_LINE,
                start_new_session=True,
            )  # fmt: skip
        return Computer(host, process, said)

    async def _end(self) -> None:
        await asyncio.gather(*(computer.ended() for computer in self._computers.values()))
