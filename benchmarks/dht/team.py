"""The processes of one library's nodes, which receive orders and are ended by their ids."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

from benchmarks.dht.library import HOST, Library
from benchmarks.remote import RemoteProcess
from sim.demo.free_ports import TCP_AND_UDP, find_free_ports

ROOT = Path(__file__).resolve().parents[2]
SPAWNED_AT_ONCE = 4
SPAWN_LIMIT_S = 30.0
ORDER_LIMIT_S = 30.0
MAX_LINE_BYTES = 1 << 24


class Node(RemoteProcess):
    """The process of one node."""

    def __init__(self, port: int, process: asyncio.subprocess.Process, errors: Path) -> None:
        super().__init__(f"the node on port {port}", process, errors)
        self.port = port

    async def run_order(self, do: str, patience_s: float = ORDER_LIMIT_S, /, **fields: Any) -> dict[str, Any]:
        """Execute an order; raises ``OrderFailed``."""
        return await super().run_order(do, patience_s, **fields)


class Team:
    """The nodes of one library; ``async with`` spawns and ends their processes; orders start the nodes."""

    def __init__(self, entry: Library, size: int, folder: str) -> None:
        self.library = entry
        self.nodes: list[Node] = []
        self._size = size
        self._folder = Path(folder)

    @property
    def pids(self) -> list[int]:
        """The ids of the live processes."""
        return [node.pid for node in self.nodes if node.is_alive]

    async def __aenter__(self) -> Team:
        try:
            ports = find_free_ports(
                TCP_AND_UDP, HOST, self._size
            )  # some of the compared libraries use UDP, some also TCP
            for first in range(0, self._size, SPAWNED_AT_ONCE):
                spawned = [await self._spawn(port) for port in ports[first : first + SPAWNED_AT_ONCE]]
                for node in spawned:
                    await node.wait_ready(SPAWN_LIMIT_S)
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(self, *trouble: object) -> None:
        await self._end()

    async def _spawn(self, port: int) -> Node:
        command = [sys.executable, "-m", "benchmarks.dht.child", self.library.name, str(self._folder)]
        pipe, error_path = asyncio.subprocess.PIPE, self._folder / f"{port}.errors"
        with error_path.open("wb") as errors:
            # In a separate session, so that signals from the terminal reach only the parent.
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, stderr=errors, cwd=ROOT, limit=MAX_LINE_BYTES, start_new_session=True
            )
        node = Node(port, process, error_path)
        self.nodes.append(node)
        return node

    async def _end(self) -> None:
        await asyncio.gather(*(node.kill() for node in self.nodes))
