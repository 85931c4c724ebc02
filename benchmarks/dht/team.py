"""Team: the processes of one library's nodes, given orders in JSON lines and ended by their ids."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from benchmarks.dht.contestant import HOST, Entry

ROOT = Path(__file__).resolve().parents[2]
SPAWNED_AT_ONCE = 4
SPAWN_S = 30.0
ORDER_S = 30.0
MAX_LINE = 1 << 24


class Lost(Exception):
    """A node's process ended, did not answer an order in time, or cannot do what was ordered."""


class Node:
    """One process; ``orders`` are answered by id."""

    def __init__(self, port: int, process: asyncio.subprocess.Process, errors: Path) -> None:
        self.port = port
        self.pid = process.pid
        self.is_alive = True
        self._process = process
        self._errors = errors
        self._number = 0
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {0: asyncio.get_running_loop().create_future()}
        self._reading = asyncio.ensure_future(self._read())

    async def up(self) -> None:
        """Wait until the process takes orders."""
        await self._answered(0, "come up", SPAWN_S)

    async def order(self, do: str, patience_s: float = ORDER_S, /, **fields: Any) -> dict[str, Any]:
        """Have something done; raises ``Lost``."""
        self._number += 1
        self._waiting[self._number] = asyncio.get_running_loop().create_future()
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, "id": self._number, **fields}).encode() + b"\n")
        answer = await self._answered(self._number, do, patience_s)
        if "cannot" in answer:
            raise Lost(answer["cannot"])
        return answer

    def send(self, number: signal.Signals) -> None:
        """Kill or stop the process; either way it takes no more orders."""
        self.is_alive = False
        if self._process.returncode is None:
            self._process.send_signal(number)

    async def ended(self) -> None:
        """Kill the process and wait until it is gone; also one that was stopped."""
        self.send(signal.SIGKILL)
        await self._process.wait()
        self._reading.cancel()

    async def _answered(self, number: int, what: str, limit_s: float) -> dict[str, Any]:
        try:
            return await asyncio.wait_for(self._waiting[number], limit_s)
        except TimeoutError:
            raise Lost(f"the node on port {self.port} did not {what} within {limit_s:g} s") from None
        finally:
            self._waiting.pop(number, None)

    async def _read(self) -> None:
        assert self._process.stdout is not None
        while line := await self._process.stdout.readline():
            answer = json.loads(line)
            waiting = self._waiting.get(answer["id"])
            if waiting is not None and not waiting.done():
                waiting.set_result(answer)
        last = (self._errors.read_text(errors="replace").strip() or "without a word").splitlines()[-1]
        for waiting in self._waiting.values():
            if not waiting.done():
                waiting.set_exception(Lost(f"the process of the node on port {self.port} ended: {last}"))
                waiting.exception()


class Team:
    """The nodes of one contestant, spawned by ``async with``; none is started, all are ended at the end."""

    def __init__(self, entry: Entry, size: int, folder: str) -> None:
        self.entry = entry
        self.nodes: list[Node] = []
        self._size = size
        self._folder = Path(folder)

    @property
    def pids(self) -> list[int]:
        """The processes that are alive."""
        return [node.pid for node in self.nodes if node.is_alive]

    async def __aenter__(self) -> Team:
        try:
            ports = free_ports(self._size)
            for first in range(0, self._size, SPAWNED_AT_ONCE):
                spawned = [await self._spawn(port) for port in ports[first : first + SPAWNED_AT_ONCE]]
                for node in spawned:
                    await node.up()
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(self, *trouble: object) -> None:
        await self._end()

    async def _spawn(self, port: int) -> Node:
        command = [sys.executable, "-m", "benchmarks.dht.child", self.entry.name, str(self._folder)]
        pipe, said = asyncio.subprocess.PIPE, self._folder / f"{port}.errors"
        with said.open("wb") as errors:
            # In a session of its own: what is typed at the terminal is for the one who ends the nodes.
            process = await asyncio.create_subprocess_exec(
                *command, stdin=pipe, stdout=pipe, stderr=errors, cwd=ROOT, limit=MAX_LINE, start_new_session=True
            )
        node = Node(port, process, said)
        self.nodes.append(node)
        return node

    async def _end(self) -> None:
        await asyncio.gather(*(node.ended() for node in self.nodes))


def free_ports(count: int) -> list[int]:
    """Ports that nobody uses now, for UDP and TCP alike."""
    held: list[socket.socket] = []
    ports: list[int] = []
    while len(ports) < count:
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        held += [udp, tcp]
        udp.bind((HOST, 0))
        try:
            tcp.bind((HOST, udp.getsockname()[1]))
        except OSError:
            continue
        ports.append(udp.getsockname()[1])
    for one in held:
        one.close()
    return ports
