"""Control a child process that receives orders in JSON lines and answers them by id."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path
from typing import Any


class OrderFailed(Exception):
    """A process exited, did not answer an order in time, or could not execute it."""


class OrderImpossible(OrderFailed):
    """The error that a process reports for an order that it cannot execute."""


class RemoteProcess:
    """A child process, called ``name`` in errors; the file ``errors`` has its standard error.

    It sends an answer with the id 0 when it is ready for orders.
    """

    def __init__(self, name: str, process: asyncio.subprocess.Process, errors: Path) -> None:
        self.name = name
        self.pid = process.pid
        self.is_alive = True
        self._process = process
        self._errors = errors
        self._number = 0
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {0: asyncio.get_running_loop().create_future()}
        self._reading = asyncio.ensure_future(self._read())

    async def wait_ready(self, limit_s: float) -> None:
        """Wait until it is ready for orders."""
        await self._await_answer(0, "come up", limit_s)

    async def run_order(self, do: str, patience_s: float, /, **fields: Any) -> dict[str, Any]:
        """Execute an order and return its answer; raises ``OrderFailed``."""
        self._number += 1
        self._waiting[self._number] = asyncio.get_running_loop().create_future()
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, "id": self._number, **fields}).encode() + b"\n")
        answer = await self._await_answer(self._number, do, patience_s)
        if "cannot" in answer:
            raise OrderImpossible(answer["cannot"])
        return answer

    def send_signal(self, number: signal.Signals) -> None:
        """Kill or stop the process; either way it accepts no more orders."""
        self.is_alive = False
        if self._process.returncode is None:
            self._process.send_signal(number)

    async def kill(self) -> None:
        """Kill it, also if it is stopped, and wait until it has exited."""
        self.send_signal(signal.SIGKILL)
        await self._process.wait()
        self._reading.cancel()

    async def _await_answer(self, number: int, what: str, limit_s: float) -> dict[str, Any]:
        try:
            return await asyncio.wait_for(self._waiting[number], limit_s)
        except TimeoutError:
            raise OrderFailed(f"{self.name} did not {what} within {limit_s:g} s") from None
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
                waiting.set_exception(OrderFailed(f"the process of {self.name} ended: {last}"))
                waiting.exception()
