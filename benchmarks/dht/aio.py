"""Base class of the libraries' nodes that use an asyncio loop, or threads that call back into the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from benchmarks.dht.library import Cancel, OnDone, OnValue


class AsyncioPeer:
    """A node that runs in an asyncio loop; threads of the measured library call the loop by ``self.call_soon``."""

    def __init__(self, folder: str) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    def run(self, begin: Callable[[], None]) -> None:
        """Run the loop."""

        async def forever() -> None:
            self._loop = asyncio.get_running_loop()
            begin()
            await asyncio.Event().wait()

        asyncio.run(forever())

    def call_soon(self, call: Callable[..., object], *arguments: object) -> None:
        """Schedule a call in the loop from any thread."""
        self._loop.call_soon_threadsafe(call, *arguments)

    def call_later(self, seconds: float, call: Callable[..., object], *arguments: object) -> Cancel:
        """Schedule a call after ``seconds``."""
        return self._loop.call_later(seconds, call, *arguments).cancel

    def run_in_thread(self, work: Coroutine[Any, Any, Any], done: Callable[[Any], object]) -> None:
        """Run ``work`` and call ``done`` with its result, or None after an error."""
        task = self._loop.create_task(work)
        self._tasks.add(task)

        def ended(task: asyncio.Task[Any]) -> None:
            self._tasks.discard(task)
            done(None if task.cancelled() or task.exception() else task.result())

        task.add_done_callback(ended)

    def list_held(self, keys: list[str]) -> list[bool | None]:
        """Return None (unknown); libraries that can list their stored keys override this."""
        return [None] * len(keys)

    def watch(self, key: str, heard: OnValue, done: Callable[[], None]) -> None:
        """Raise ``NotImplementedError``; libraries that have watches override this."""
        raise NotImplementedError("this library has no watches")

    def run_space_operation(self, verb: str, fields: list[object], limit_s: float, done: OnDone) -> None:
        """Raise ``NotImplementedError``: none of these libraries has a tuple space."""
        raise NotImplementedError("this library has no tuple space")

    def drop_datagrams(self, share: float) -> None:
        """Raise ``NotImplementedError``: the sockets of these libraries are not accessible."""
        raise NotImplementedError("the sockets of this library are not accessible")
