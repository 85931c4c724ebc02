"""Control the child processes on the hosts of the test network."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.remote import OrderFailed, OrderImpossible, RemoteProcess
from sim.namespaces.internet import ROOT, Internet
from sim.namespaces.namespace import make_environment

SPAWN_LIMIT_S = 60.0
MARGIN_S = 10.0
"""Seconds after the time limit of an order until its answer is regarded as lost."""
MAX_LINE_BYTES = 1 << 20


class HostProcess(RemoteProcess):
    """The child process of one host, with orders that may take some time."""

    async def run_order(self, do: str, limit_s: float = 0.0, /, **fields: Any) -> dict[str, Any]:
        """Execute an order that may take ``limit_s``; raises ``OrderFailed``."""
        try:
            return await super().run_order(do, limit_s + MARGIN_S, limit_s=limit_s, **fields)
        except OrderImpossible as error:
            raise OrderFailed(f"{self.name} could not {do}: {error}") from None


class Hosts:
    """A child process on each of ``hosts``, during an ``async with`` block."""

    def __init__(self, net: Internet, hosts: Iterable[str], folder: Path) -> None:
        self.net = net
        self._hosts = list(hosts)
        self._folder = folder
        self._processes_by_host: dict[str, HostProcess] = {}

    def __getitem__(self, host: str) -> HostProcess:
        return self._processes_by_host[host]

    async def __aenter__(self) -> Hosts:
        try:
            for host in self._hosts:
                self._processes_by_host[host] = await self._spawn(host)
            await asyncio.gather(*(computer.wait_ready(SPAWN_LIMIT_S) for computer in self._processes_by_host.values()))
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(self, *trouble: object) -> None:
        await self._end()

    async def _spawn(self, host: str) -> HostProcess:
        error_path, pipe = self._folder / f"{host}.errors", asyncio.subprocess.PIPE
        command = self.net.command(host, [sys.executable, "-m", "benchmarks.nat.child"])
        with error_path.open("wb") as errors:
            # In a separate session, so that signals from the terminal reach only the parent.
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, stderr=errors, cwd=ROOT, env=make_environment(),
                limit=MAX_LINE_BYTES, start_new_session=True,
            )  # fmt: skip
        return HostProcess(host, process, error_path)

    async def _end(self) -> None:
        await asyncio.gather(*(computer.kill() for computer in self._processes_by_host.values()))
