"""Continuous display of a robot's readings; the newest picture is saved to a file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from drivers.driver import Driver
from drivers.reading import Frame, Observation
from drivers.timer import Timer
from swarmnode.driver.formatting import format_reading, make_json_safe
from swarmnode.driver.probe import SILENCE_TIMEOUT_S

DISPLAY_INTERVAL_S = 1.0
"""Seconds between two displays, and between two saved pictures."""


class Monitor:
    """Shows the readings of ``driver`` by ``show`` until it is stopped, or for ``seconds`` after the first reading.

    It sends no commands, so the motors keep their state.
    """

    def __init__(
        self,
        driver: Driver,
        clock: IReactorTime,
        show: Callable[[list[str]], None],
        seconds: float = math.inf,
        picture: Path | None = None,
        is_json: bool = False,
        problems: Callable[[], list[str]] = list,
    ) -> None:
        self.code = 0
        self._driver = driver
        self._clock = clock
        self._show = show
        self._seconds = seconds
        self._picture = picture
        self._is_json = is_json
        self._problems = problems
        self._shown_problems: set[str] = set()
        self._saved_seq = -1
        self._started_at = clock.seconds()
        self._first_at: float | None = None
        self._timer = Timer(clock)
        self._is_over = False
        self._ended: Deferred[int] = Deferred()

    def start(self) -> Deferred[int]:
        """Begin; the Deferred fires with the exit code when the robot is disconnected."""
        self._driver.connect().addErrback(self._on_refused)
        if not self._is_over:
            self._on_time()
        return self._ended

    def end(self) -> Deferred[int]:
        """Disconnect from the robot."""
        if not self._is_over:
            self._is_over = True
            self._timer.cancel()
            newest = self._driver.observe()
            if newest is None:
                self.code = 1
            elif self._picture is not None and self._saved_seq < 0 and self.code == 0:
                self._fail("no picture received; check that its camera is on")
            leaving = self._driver.disconnect()
            leaving.addBoth(lambda _: self._ended.callback(self.code))
        return self._ended

    def _on_refused(self, failure: Failure) -> None:
        if not self._is_over:
            self._fail(" ".join(failure.getErrorMessage().split()))
            self.end()

    def _on_time(self) -> None:
        now, newest = self._clock.seconds(), self._driver.observe()
        for problem in self._problems():
            if problem not in self._shown_problems:
                self._shown_problems.add(problem)
                self._show([f"! {problem}"])
        if newest is None and now - self._started_at > SILENCE_TIMEOUT_S:
            self._fail(f"no data within {SILENCE_TIMEOUT_S:g} s; run swarm driver probe for details")
            self.end()
            return
        if newest is not None:
            self._first_at = now if self._first_at is None else self._first_at
            self._show(list(self._format_readings(newest, now)))
            if self._picture is not None and newest.frame is not None and newest.frame.seq != self._saved_seq:
                self._save(newest.frame)
            if self._is_over or now - self._first_at >= self._seconds - 1e-9:
                self.end()
                return
        self._timer.set(0.1 if newest is None else DISPLAY_INTERVAL_S, self._on_time)

    def _format_readings(self, newest: Observation, now: float) -> Iterator[str]:
        if self._is_json:
            yield json.dumps(observation_to_data(self._driver.state, newest, now))
        else:
            yield from format_readings(self._driver.state, newest, self._driver.diagnostics(), now)

    def _save(self, frame: Frame) -> None:
        assert self._picture is not None
        if frame.encoding != "jpeg":
            self._fail(f"the pictures are {frame.encoding}, not JPEG; no picture was saved")
            self.end()
            return
        temporary = self._picture.with_name(f".{self._picture.name}.new")
        try:
            temporary.write_bytes(frame.data)
            os.replace(temporary, self._picture)
        except OSError as error:
            self._fail(f"cannot write {self._picture}: {error.strerror or error}")
            self.end()
            return
        self._saved_seq = frame.seq

    def _fail(self, problem: str) -> None:
        self.code = 1
        self._show([f"! {problem}"])


def format_readings(state: str, newest: Observation, counts: dict[str, float], now: float) -> Iterator[str]:
    """Yield a line about the link, then each reading on a line."""
    yield f"{state}, {now - newest.t_host:.2f} s old, {counts['frames']:g} frames, {counts['bad_frames']:g} bad"
    width = max(map(len, newest.values), default=0)
    for key in sorted(newest.values):
        yield f"  {key:{width}}  {format_reading(key, newest.values[key])}"
    if newest.frame is not None:
        frame = newest.frame
        yield f"  {'camera':{width}}  {frame.width} x {frame.height} {frame.encoding}, number {frame.seq}"


def observation_to_data(state: str, newest: Observation, now: float) -> dict[str, Any]:
    """Return an observation as plain data for JSON; NaN and infinities become None."""
    data: dict[str, Any] = {"state": state, "age": now - newest.t_host, "t_robot": newest.t_robot}
    data["values"] = make_json_safe(newest.values)
    if newest.frame is not None:
        data["picture"] = {"seq": newest.frame.seq, "width": newest.frame.width, "height": newest.frame.height}
    return data
