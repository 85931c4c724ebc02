"""Thread: a camera makes whoever asks it wait, so it is asked in a thread of its own; and its twin on a turned clock.

Both hand over at most one picture at a time: one that nobody has taken yet gives way to a newer one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.camera.shots import Shot, Shots
from drivers.errors import BadFrame, LinkLost
from drivers.timer import Timer

FIRST_RETRY_S, LAST_RETRY_S = 0.5, 5.0
JOIN_S = 2.0
"""A camera that does not answer for longer is left behind with its thread, which ends with the process."""

Hand = Callable[[Callable[[], None]], None]
"""Calls something on the reactor's thread (``reactor.callFromThread``)."""


class Viewer(Protocol):
    """Who is told; always on the reactor's thread."""

    def shown(self, shot: Shot) -> None:
        """Take a picture."""

    def spoilt(self, reason: str) -> None:
        """Learn that a picture was none."""

    def gone(self, reason: str) -> None:
        """Learn that there are no pictures now; it is tried again."""


class Film(Protocol):
    """A standing wish for pictures."""

    def start(self, viewer: Viewer, fps: float) -> None:
        """Begin."""

    def set_fps(self, fps: float) -> None:
        """So many a second from now on; 0: none."""

    def stop(self) -> Deferred[None]:
        """End; nothing is told any more; fires when the camera is free, or left behind."""


class Retry:
    """How long to wait after each failure: twice as long each time, up to ``LAST_RETRY_S``."""

    def __init__(self) -> None:
        self._next_s = FIRST_RETRY_S

    def fail(self) -> float:
        """Seconds to wait now."""
        wait, self._next_s = self._next_s, min(2 * self._next_s, LAST_RETRY_S)
        return wait

    def succeed(self) -> None:
        """Begin anew."""
        self._next_s = FIRST_RETRY_S


class Reel:
    """One round after another: open what is closed, take a picture, say what came of it and when to come again.

    ``tell`` gets what the viewer is to be told; it must not block.
    """

    def __init__(self, shots: Shots, tell: Callable[[str, Any], None]) -> None:
        self._shots = shots
        self._tell = tell
        self._retry = Retry()
        self._is_open = False

    def turn(self) -> float:
        """One round; seconds until it should be tried again after a failure, 0 after a picture."""
        try:
            if not self._is_open:
                self._shots.open()
                self._is_open = True
            shot = self._shots.shoot()
        except BadFrame as error:
            self._tell("spoilt", str(error))
            return 0.0
        except LinkLost as error:
            self.close()
            self._tell("gone", str(error))
            return self._retry.fail()
        except Exception as error:  # OpenCV's own: whatever a camera does, its thread lives
            self.close()
            self._tell("gone", f"{type(error).__name__}: {error}"[:300])
            return self._retry.fail()
        self._retry.succeed()
        self._tell("shown", shot)
        return 0.0

    def close(self) -> None:
        """Let the camera go."""
        self._is_open = False
        self._shots.close()


class ClockFilm:
    """Pictures of files, each at its moment of ``clock``: the same run shows the same pictures."""

    def __init__(self, shots: Shots, clock: IReactorTime) -> None:
        self._reel = Reel(shots, self._tell)
        self._viewer: Viewer | None = None
        self._fps = 0.0
        self._pending = Timer(clock)

    def start(self, viewer: Viewer, fps: float) -> None:
        """Begin with the first picture, at once but not within this call."""
        self._viewer, self._fps = viewer, fps
        self._pending.set(0.0, self._on_time)

    def set_fps(self, fps: float) -> None:
        """So many a second from now on; 0: none."""
        self._fps = fps
        if self._viewer is not None:
            self._pending.cancel()
            if fps > 0:
                self._pending.set(1.0 / fps, self._on_time)

    def stop(self) -> Deferred[None]:
        """End."""
        self._viewer = None
        self._pending.cancel()
        self._reel.close()
        return succeed(None)

    def _on_time(self) -> None:
        wait = max(self._reel.turn(), 1.0 / self._fps if self._fps > 0 else 0.0)
        if self._viewer is not None and self._fps > 0 and not self._pending.is_set:
            self._pending.set(wait, self._on_time)

    def _tell(self, what: str, said: Any) -> None:
        if self._viewer is not None:
            getattr(self._viewer, what)(said)


class ThreadFilm:
    """Pictures of a camera, which takes its time; ``hand`` brings them to the reactor's thread."""

    def __init__(self, shots: Shots, hand: Hand) -> None:
        self._hand = hand
        self._reel = Reel(shots, self._tell)
        self._viewer: Viewer | None = None
        self._fps = 0.0
        self._end = threading.Event()
        self._changed = threading.Condition()
        self._waiting: list[tuple[str, Any]] = []
        self._thread: threading.Thread | None = None
        self.dropped = 0
        """Pictures that gave way to a newer one."""

    def start(self, viewer: Viewer, fps: float) -> None:
        """Begin."""
        self._viewer, self._fps = viewer, fps
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def set_fps(self, fps: float) -> None:
        """So many a second from now on; 0: none."""
        with self._changed:
            self._fps = fps
            self._changed.notify_all()

    def stop(self) -> Deferred[None]:
        """End, and wait for the thread a little, so that the camera is free."""
        self._viewer = None
        self._end.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(JOIN_S)
        return succeed(None)

    def _run(self) -> None:
        while not self._end.is_set():
            began = time.monotonic()
            wait = self._reel.turn()
            with self._changed:
                fps, took = self._fps, time.monotonic() - began
                pause = None if fps <= 0 else max(wait, 1.0 / fps - took)
                if not self._end.is_set() and (pause is None or pause > 0):
                    # Without pictures wanted the camera rests; a change or the end wakes it.
                    self._changed.wait(pause)
        self._reel.close()

    def _tell(self, what: str, said: Any) -> None:
        with self._changed:
            is_first = not self._waiting
            if self._waiting and what == "shown" and self._waiting[-1][0] == "shown":
                self.dropped += 1
                self._waiting[-1] = (what, said)
            elif len(self._waiting) < 4:
                self._waiting.append((what, said))
        if is_first:
            self._hand(self._take)

    def _take(self) -> None:
        with self._changed:
            waiting, self._waiting = self._waiting, []
        for what, said in waiting:
            if self._viewer is not None:
                getattr(self._viewer, what)(said)
