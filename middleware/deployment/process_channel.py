"""The channel to a module's process, over two pipes in non-blocking mode."""

from __future__ import annotations

import fcntl
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress

from middleware.deployment.module_channel import (
    MAX_REPLY_BYTES,
    MAX_REQUEST_BYTES,
    BadFrame,
    FrameSplitter,
    ProcessEnded,
)

PIPE_BYTES = 1024 * 1024
"""Requested size of the pipe to the process, so that a picture fits into it."""
READ_BYTES = 64 * 1024
MAX_READ_BYTES = 1024 * 1024
"""Maximum number of bytes per read."""
ENVIRONMENT = {
    # These variables give sets the same order on every machine, and keep numeric libraries from starting threads.
    "PYTHONHASHSEED": "0",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}


SANDBOX = "swarmnode.sandbox"
"""The program that runs a module."""


class ProcessChannel:
    """A process that runs ``python -m program``.

    It does not inherit the open files, environment and working folder of this process.
    """

    def __init__(self, program: str = SANDBOX) -> None:
        self._folder = tempfile.mkdtemp(prefix="swarm-module-")
        path = os.pathsep.join([*filter(None, sys.path), os.getcwd()])
        try:
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                [sys.executable, "-s", "-P", "-m", program, str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                bufsize=0,
                cwd=self._folder,
                env={**ENVIRONMENT, "PYTHONPATH": path},
                start_new_session=True,
            )
        except OSError:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        assert self._process.stdin is not None and self._process.stdout is not None
        self._in, self._out = self._process.stdin.fileno(), self._process.stdout.fileno()
        for pipe in (self._in, self._out):
            os.set_blocking(pipe, False)
        with suppress(OSError, AttributeError):  # not supported by every system
            fcntl.fcntl(self._in, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._rest = b""
        self._answers = FrameSplitter(MAX_REPLY_BYTES)

    @property
    def has_unsent(self) -> bool:
        """Whether a part of a message is not sent yet."""
        return bool(self._rest)

    @property
    def pid(self) -> int:
        """The process id."""
        return 0 if self._process is None else self._process.pid

    def send(self, message: bytes) -> None:
        """Send a message, or as much of it as the pipe takes."""
        if len(self._rest) + len(message) > 2 * MAX_REQUEST_BYTES:
            raise ProcessEnded("it does not read its requests")
        self._rest += message
        self._flush()

    def receive(self, within_s: float) -> list[bytes]:
        """Return the received messages; if there is none, wait for one for at most ``within_s`` seconds."""
        end = time.monotonic() + within_s
        found: list[bytes] = []
        while True:
            self._flush()
            found += self._read()
            left = end - time.monotonic()
            if found or left <= 0.0:
                return found
            poll = select.poll()
            poll.register(self._out, select.POLLIN)
            if self._rest:
                poll.register(self._in, select.POLLOUT)
            poll.poll(left * 1000.0)

    def kill(self) -> None:
        """Kill the process."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()
        process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _flush(self) -> None:
        if self._process is None:
            raise ProcessEnded("its process has ended")
        while self._rest:
            try:
                self._rest = self._rest[os.write(self._in, self._rest) :]
            except BlockingIOError:
                return
            except OSError as error:
                raise ProcessEnded("its process has died") from error

    def _read(self) -> list[bytes]:
        found: list[bytes] = []
        for _ in range(MAX_READ_BYTES // READ_BYTES):
            try:
                data = os.read(self._out, READ_BYTES)
            except BlockingIOError:
                return found
            except OSError as error:
                raise ProcessEnded("its process has died") from error
            if not data:
                raise ProcessEnded("its process has died")
            try:
                found += self._answers.feed(data)
            except BadFrame as error:
                raise ProcessEnded(f"its reply {error}") from error
        return found
