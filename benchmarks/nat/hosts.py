"""Hosts: the computers of an internet of network namespaces, and the orders that they take."""

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
"""Seconds beyond its own limit after which an order counts as lost."""
MAX_LINE = 1 << 20


class Computer(Remote):
    """One computer, which does what may take it a while."""

    async def order(self, do: str, limit_s: float = 0.0, /, **fields: Any) -> dict[str, Any]:
        """Have something done that may take ``limit_s``; raises ``Lost``."""
        try:
            return await super().order(do, limit_s + MARGIN_S, limit_s=limit_s, **fields)
        except Unable as error:
            raise Lost(f"{self.name} could not {do}: {error}") from None


class Hosts:
    """A computer on each of ``hosts``, between ``async with`` and its end."""

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
            # In a session of its own: what is typed at the terminal is for the one who ends it.
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, stderr=errors, cwd=ROOT, env=environment(), limit=MAX_LINE,
                start_new_session=True,
            )  # fmt: skip
        return Computer(host, process, said)

    async def _end(self) -> None:
        await asyncio.gather(*(computer.ended() for computer in self._computers.values()))
