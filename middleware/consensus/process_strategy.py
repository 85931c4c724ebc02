"""Run a third-party strategy in a separate process, so that a call that does not return can be stopped.

Code that never returns cannot be stopped safely within its own process.  The separate process protects against
mistakes, not against malicious code; the settings determine which code may be loaded.
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

from middleware.consensus.guarded_strategy import StrategyError, StrategyLost
from middleware.consensus.remote_strategy import RemoteStrategy

DEADLINE_S = 0.2
"""Maximum seconds for which one call blocks the node; well below a third of the duration of a lease."""
START_TIMEOUT_S = 5.0
MAX_RESULT_BYTES = 65_536
LENGTH_PREFIX = struct.Struct("!I")


class ProcessStrategy(RemoteStrategy):
    """The strategy at ``import_path`` (``module:Class``), called through pipes; its errors are raised here.

    ``deadline`` is the maximum duration of a call in seconds; ``path`` is searched before this process's import path.
    """

    version = ""

    def __init__(self, name: str, import_path: str, deadline: float = DEADLINE_S, path: Sequence[str] = ()) -> None:
        self.name = name
        self._import_path = import_path
        self._deadline = deadline
        self._path = path
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ready = False
        self._started_at = 0.0
        self._load_error = ""
        self._is_stopped = False
        self._start()

    def stop(self) -> None:
        """End the process; later calls raise ``StrategyError``."""
        self._is_stopped = True
        self._end()

    def _start(self) -> None:
        # A fixed hash seed makes sets iterate in the same order on every machine.
        path = os.pathsep.join((*self._path, *filter(None, sys.path), os.getcwd()))
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "middleware.consensus.strategy_worker",
                self._import_path,
                str(2.0 * self._deadline),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            env={**os.environ, "PYTHONPATH": path, "PYTHONHASHSEED": "0"},
        )
        self._is_ready, self._started_at = False, time.monotonic()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
            process.wait()

    def call(self, method: str, arguments: list[Any]) -> Any:
        """Call ``method`` in the process and return its result; raise ``StrategyError``."""
        end = time.monotonic() + self._deadline
        if self._load_error:
            raise StrategyRaised(self._load_error)
        if self._is_stopped:
            raise StrategyError("the strategy was stopped")
        if self._process is None:
            self._start()
        try:
            if not self._is_ready:
                self._unpack(self._read(end))
                self._is_ready = True
            self._write(bytes(msgpack.packb([method, arguments])), end)
            return self._unpack(self._read(end))
        except TimeoutError:
            if not self._is_ready and time.monotonic() - self._started_at < START_TIMEOUT_S:
                raise StrategyError("the strategy is still loading") from None
            self._end()
            raise StrategyLost(f"no result within {self._deadline:g} s") from None
        except (OSError, ValueError, StrategyError) as error:
            if not self._is_ready and isinstance(error, StrategyRaised):
                self._load_error = str(error)
            if not self._is_ready or not isinstance(error, StrategyRaised):
                self._end()
            if isinstance(error, OSError):
                raise StrategyLost("the process of the strategy has ended") from error
            raise

    def _unpack(self, answer: bytes) -> Any:
        try:
            is_ok, content = msgpack.unpackb(answer)
        except Exception as error:  # msgpack raises many types of exceptions
            raise StrategyLost("the result of the strategy cannot be decoded") from error
        if not is_ok:
            raise StrategyRaised(str(content))
        return content

    def _write(self, request: bytes, end: float) -> None:
        assert self._process is not None and self._process.stdin is not None
        pipe = self._process.stdin
        os.set_blocking(pipe.fileno(), False)
        rest = LENGTH_PREFIX.pack(len(request)) + request
        while rest:
            _wait(pipe.fileno(), select.POLLOUT, end)
            rest = rest[os.write(pipe.fileno(), rest) :]

    def _read(self, end: float) -> bytes:
        (size,) = LENGTH_PREFIX.unpack(self._read_bytes(LENGTH_PREFIX.size, end))
        if size > MAX_RESULT_BYTES:
            raise StrategyLost(f"the result of the strategy has {size} bytes; at most {MAX_RESULT_BYTES} are allowed")
        return self._read_bytes(size, end)

    def _read_bytes(self, size: int, end: float) -> bytes:
        assert self._process is not None and self._process.stdout is not None
        found = b""
        while len(found) < size:
            _wait(self._process.stdout.fileno(), select.POLLIN, end)
            more = os.read(self._process.stdout.fileno(), size - len(found))
            if not more:
                raise StrategyLost("the process of the strategy has ended")
            found += more
        return found


class StrategyRaised(StrategyError):
    """The strategy raised an exception; the text is the traceback."""


def _wait(pipe: int, event: int, end: float) -> None:
    poll = select.poll()
    poll.register(pipe, event)
    if not poll.poll(max(0.0, end - time.monotonic()) * 1000.0):
        raise TimeoutError
