"""Worker: a strategy of somebody else in a process of its own, so that it can be ended when it does not.

Code that never returns cannot be stopped from within its own process without harm; a process can.  This is against
mistakes and not against malice: what may be loaded at all is decided elsewhere.
"""

from __future__ import annotations

import os
import select
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import msgpack

from middleware.consensus.guard import Lost, NoOpinion
from middleware.consensus.remote import RemoteStrategy

DEADLINE_S = 0.2
"""How long the node stands still at most for one question; well below the third of a lease."""
START_S = 5.0
MAX_ANSWER = 65_536
LENGTH = struct.Struct("!I")


class Worker(RemoteStrategy):
    """The strategy at ``place`` (``module:Class``), asked through pipes; each method raises what went wrong.

    ``path`` comes before this process's own path for imports.
    """

    version = ""

    def __init__(self, name: str, place: str, deadline: float = DEADLINE_S, path: Sequence[str] = ()) -> None:
        self.name = name
        self._place = place
        self._deadline = deadline
        self._path = path
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ready = False
        self._began = 0.0
        self._broken = ""
        self._is_stopped = False
        self._start()

    def stop(self) -> None:
        """End the process for good: whoever still asks gets no answer, and no new process."""
        self._is_stopped = True
        self._end()

    def _start(self) -> None:
        # Sets come out in the same order on every machine.
        path = os.pathsep.join((*self._path, *filter(None, sys.path), os.getcwd()))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "middleware.consensus.servant", self._place, str(2.0 * self._deadline)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            env={**os.environ, "PYTHONPATH": path, "PYTHONHASHSEED": "0"},
        )
        self._is_ready, self._began = False, time.monotonic()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
            process.wait()

    def ask(self, method: str, arguments: list[Any]) -> Any:
        """The answer of its process; raises ``NoOpinion``."""
        end = time.monotonic() + self._deadline
        if self._broken:
            raise Raised(self._broken)
        if self._is_stopped:
            raise NoOpinion("it was stopped")
        if self._process is None:
            self._start()
        try:
            if not self._is_ready:
                self._heard(self._read(end))
                self._is_ready = True
            self._write(bytes(msgpack.packb([method, arguments])), end)
            return self._heard(self._read(end))
        except TimeoutError:
            if not self._is_ready and time.monotonic() - self._began < START_S:
                raise NoOpinion("it is still being loaded") from None
            self._end()
            raise Lost(f"it did not answer within {self._deadline:g} s") from None
        except (OSError, ValueError, NoOpinion) as error:
            if not self._is_ready and isinstance(error, Raised):
                self._broken = str(error)
            if not self._is_ready or not isinstance(error, Raised):
                self._end()
            if isinstance(error, OSError):
                raise Lost("its process has died") from error
            raise

    def _heard(self, answer: bytes) -> Any:
        try:
            is_well, content = msgpack.unpackb(answer)
        except Exception as error:  # msgpack raises many things
            raise Lost("its answer cannot be read") from error
        if not is_well:
            raise Raised(str(content))
        return content

    def _write(self, question: bytes, end: float) -> None:
        assert self._process is not None and self._process.stdin is not None
        pipe = self._process.stdin
        os.set_blocking(pipe.fileno(), False)
        rest = LENGTH.pack(len(question)) + question
        while rest:
            _wait(pipe.fileno(), select.POLLOUT, end)
            rest = rest[os.write(pipe.fileno(), rest) :]

    def _read(self, end: float) -> bytes:
        (size,) = LENGTH.unpack(self._bytes(LENGTH.size, end))
        if size > MAX_ANSWER:
            raise Lost(f"its answer has {size} bytes, more than {MAX_ANSWER}")
        return self._bytes(size, end)

    def _bytes(self, size: int, end: float) -> bytes:
        assert self._process is not None and self._process.stdout is not None
        found = b""
        while len(found) < size:
            _wait(self._process.stdout.fileno(), select.POLLIN, end)
            more = os.read(self._process.stdout.fileno(), size - len(found))
            if not more:
                raise Lost("its process has died")
            found += more
        return found


class Raised(NoOpinion):
    """The strategy raised; the text is its trace."""


def _wait(pipe: int, event: int, end: float) -> None:
    poll = select.poll()
    poll.register(pipe, event)
    if not poll.poll(max(0.0, end - time.monotonic()) * 1000.0):
        raise TimeoutError
