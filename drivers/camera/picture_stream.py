"""Read a blocking camera in its own thread, or read files at times of a clock.

Both streams deliver at most one picture at a time: a picture that has not been consumed is replaced by the next one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.camera.source import JpegPicture, PictureSource
from drivers.errors import BadFrame, LinkLost
from drivers.timer import Timer

FIRST_RETRY_S, MAX_RETRY_S = 0.5, 5.0
JOIN_TIMEOUT_S = 2.0
"""Seconds to wait for the thread; a camera that blocks longer is abandoned, and its thread ends with the process."""

RunInReactor = Callable[[Callable[[], None]], None]
"""Runs a function on the reactor's thread (``reactor.callFromThread``)."""


class PictureReceiver(Protocol):
    """Receives pictures and errors, always on the reactor's thread."""

    def on_picture(self, picture: JpegPicture) -> None:
        """Process a picture."""

    def on_invalid_picture(self, reason: str) -> None:
        """Handle an invalid picture."""

    def on_source_lost(self, reason: str) -> None:
        """Handle the loss of the source; the stream retries."""


class PictureStream(Protocol):
    """A source of pictures that reopens itself."""

    def start(self, receiver: PictureReceiver, fps: float) -> None:
        """Start to deliver pictures to ``receiver``."""

    def set_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops."""

    def stop(self) -> Deferred[None]:
        """Stop all deliveries; fires when the camera is released or abandoned."""


class Backoff:
    """Delays after failures: doubled each time, up to ``MAX_RETRY_S``."""

    def __init__(self) -> None:
        self._next_s = FIRST_RETRY_S

    def increase(self) -> float:
        """Return the seconds to wait now."""
        wait, self._next_s = self._next_s, min(2 * self._next_s, MAX_RETRY_S)
        return wait

    def reset(self) -> None:
        """Reset the delay."""
        self._next_s = FIRST_RETRY_S


class SourceReader:
    """Opens the source if necessary, takes pictures, and reports results.

    ``tell`` is called with the name of a method of ``PictureReceiver`` and its argument, and must not block.
    """

    def __init__(self, source: PictureSource, tell: Callable[[str, Any], None]) -> None:
        self._source = source
        self._report = tell
        self._backoff = Backoff()
        self._is_open = False

    def read_picture(self) -> float:
        """Take one picture; return the seconds to wait after a failure, 0 after a picture."""
        try:
            if not self._is_open:
                self._source.open()
                self._is_open = True
            picture = self._source.read_picture()
        except BadFrame as error:
            self._report("on_invalid_picture", str(error))
            return 0.0
        except LinkLost as error:
            self.close()
            self._report("on_source_lost", str(error))
            return self._backoff.increase()
        except Exception as error:  # an error of OpenCV must not end the thread
            self.close()
            self._report("on_source_lost", f"{type(error).__name__}: {error}"[:300])
            return self._backoff.increase()
        self._backoff.reset()
        self._report("on_picture", picture)
        return 0.0

    def close(self) -> None:
        """Release the camera."""
        self._is_open = False
        self._source.close()


class TimedStream:
    """Pictures from files, timed by ``clock``, so repeated runs deliver the same pictures."""

    def __init__(self, source: PictureSource, clock: IReactorTime) -> None:
        self._reader = SourceReader(source, self._report)
        self._receiver: PictureReceiver | None = None
        self._fps = 0.0
        self._pending = Timer(clock)

    def start(self, receiver: PictureReceiver, fps: float) -> None:
        """Deliver the first picture immediately, but not within this call."""
        self._receiver, self._fps = receiver, fps
        self._pending.set(0.0, self._on_time)

    def set_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops."""
        self._fps = fps
        if self._receiver is not None:
            self._pending.cancel()
            if fps > 0:
                self._pending.set(1.0 / fps, self._on_time)

    def stop(self) -> Deferred[None]:
        """Stop."""
        self._receiver = None
        self._pending.cancel()
        self._reader.close()
        return succeed(None)

    def _on_time(self) -> None:
        wait = max(self._reader.read_picture(), 1.0 / self._fps if self._fps > 0 else 0.0)
        if self._receiver is not None and self._fps > 0 and not self._pending.is_set:
            self._pending.set(wait, self._on_time)

    def _report(self, method: str, argument: Any) -> None:
        if self._receiver is not None:
            getattr(self._receiver, method)(argument)


class ThreadedStream:
    """Pictures of a blocking camera; ``run_in_reactor`` transfers them to the reactor's thread."""

    def __init__(self, source: PictureSource, run_in_reactor: RunInReactor) -> None:
        self._run_in_reactor = run_in_reactor
        self._reader = SourceReader(source, self._report)
        self._receiver: PictureReceiver | None = None
        self._fps = 0.0
        self._stop_event = threading.Event()
        self._changed = threading.Condition()
        self._queue: list[tuple[str, Any]] = []
        self._thread: threading.Thread | None = None
        self.dropped = 0
        """Number of pictures that were replaced by a newer picture."""

    def start(self, receiver: PictureReceiver, fps: float) -> None:
        """Start the thread."""
        self._receiver, self._fps = receiver, fps
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def set_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops."""
        with self._changed:
            self._fps = fps
            self._changed.notify_all()

    def stop(self) -> Deferred[None]:
        """Stop the thread and wait up to ``JOIN_TIMEOUT_S`` for it, so that the camera is released."""
        self._receiver = None
        self._stop_event.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(JOIN_TIMEOUT_S)
        return succeed(None)

    def _run(self) -> None:
        while not self._stop_event.is_set():
            began = time.monotonic()
            wait = self._reader.read_picture()
            with self._changed:
                fps, took = self._fps, time.monotonic() - began
                pause = None if fps <= 0 else max(wait, 1.0 / fps - took)
                if not self._stop_event.is_set() and (pause is None or pause > 0):
                    # At rate 0 the camera is idle until the rate changes or the stream stops.
                    self._changed.wait(pause)
        self._reader.close()

    def _report(self, method: str, argument: Any) -> None:
        with self._changed:
            is_first = not self._queue
            if self._queue and method == "on_picture" and self._queue[-1][0] == "on_picture":
                self.dropped += 1
                self._queue[-1] = (method, argument)
            elif len(self._queue) < 4:
                self._queue.append((method, argument))
        if is_first:
            self._run_in_reactor(self._deliver)

    def _deliver(self) -> None:
        with self._changed:
            queue, self._queue = self._queue, []
        for method, argument in queue:
            if self._receiver is not None:
                getattr(self._receiver, method)(argument)
