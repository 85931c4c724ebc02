"""Keyboard control of a robot in a terminal, with a status line."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from drivers.driver import Driver
from drivers.reading import Observation
from drivers.timer import Timer
from swarmnode.driver.keyboard import HELP, KEY_HOLD_S, KeyboardController
from swarmnode.driver.probe import SILENCE_TIMEOUT_S

TICK_S = 0.05
STATUS_INTERVAL_S = 0.1
"""Seconds between two updates of the status line."""


class Terminal(Protocol):
    """Source of keys and output of lines."""

    def start(self, pressed: Callable[[str], None]) -> None:
        """Call ``pressed`` with each key immediately, without echo; with an empty string at the end of input."""

    def show_status(self, text: str) -> None:
        """Overwrite the status line."""

    def write_line(self, text: str) -> None:
        """Write a permanent line."""

    def close(self) -> None:
        """Restore the terminal."""


class DriveSession:
    """A session in which keys control ``driver``: it starts with the connection and ends with the motors off."""

    def __init__(
        self, driver: Driver, clock: IReactorTime, terminal: Terminal, problems: Callable[[], list[str]]
    ) -> None:
        self.controller = KeyboardController(driver)
        self._driver = driver
        self._clock = clock
        self._terminal = terminal
        self._problems = problems
        self._shown_problems: set[str] = set()
        self._started_at = clock.seconds()
        self._status_at = -math.inf
        self._timer = Timer(clock)
        self._is_over = False
        self._ended: Deferred[int] = Deferred()

    def start(self) -> Deferred[int]:
        """Begin; fires with the exit code when the robot has stopped, its motors are off, and the link is closed."""
        self._terminal.write_line(HELP)
        self._terminal.write_line(
            f"a key has effect for {KEY_HOLD_S:g} s: hold the key to continue; release it to stop the robot"
        )
        self._driver.connect().addCallbacks(self._on_connected, self._on_refused)
        self._terminal.start(self._on_key)
        if not self._is_over:
            self._on_tick()
        return self._ended

    def end(self, code: int = 0) -> Deferred[int]:
        """Stop the robot, switch its motors off and disconnect."""
        if not self._is_over:
            self._is_over = True
            self._timer.cancel()
            self.controller.stop()
            leaving = self._driver.disable() if self._driver.state == "ready" else self._driver.disconnect()
            leaving.addErrback(lambda _: None)
            leaving.addCallback(lambda _: self._driver.disconnect())
            leaving.addBoth(lambda _: self._finish(code))
        return self._ended

    def _finish(self, code: int) -> None:
        self._terminal.close()
        self._ended.callback(code)

    def _on_connected(self, _: object) -> None:
        self._enable()

    def _enable(self) -> None:
        def failed(failure: Failure) -> None:
            self.controller.message = " ".join(failure.getErrorMessage().split())

        self._driver.enable().addErrback(failed)

    def _on_refused(self, failure: Failure) -> None:
        if not self._is_over:
            self._terminal.write_line(" ".join(failure.getErrorMessage().split()))
            self.end(1)

    def _on_key(self, key: str) -> None:
        if self._is_over:
            return
        if key == "m":
            self._enable()
        elif not self.controller.press(key, self._clock.seconds()):
            self.end()
            return
        self._show_status()

    def _on_tick(self) -> None:
        self._timer.set(TICK_S, self._on_tick)
        self.controller.tick(self._clock.seconds())
        if self._clock.seconds() - self._status_at > STATUS_INTERVAL_S - 1e-9:
            self._show_status()

    def _show_status(self) -> None:
        self._status_at = self._clock.seconds()
        problems = self._problems()
        if self._driver.observe() is None and self._clock.seconds() - self._started_at > SILENCE_TIMEOUT_S:
            problems = [*problems, f"no data within {SILENCE_TIMEOUT_S:g} s; run swarm driver probe for details"]
        for problem in problems:
            if problem not in self._shown_problems:
                self._shown_problems.add(problem)
                self._terminal.write_line(f"! {problem}")
        self._terminal.show_status(
            format_status(self._driver.state, self._driver.observe(), self.controller, self._clock.seconds())
        )


def format_status(state: str, newest: Observation | None, controller: KeyboardController, now: float) -> str:
    """Return the status line: state, motion, position, nearest range, battery, age of data, last message."""
    words = [f"{state:10}", " ".join(f"{key[5:]} {value + 0.0:+.2f}" for key, value in controller.last_motion.items())]
    if newest is not None:
        values = newest.values
        if values.get("estop.engaged") is True:
            words.append("motors off (m)")
        if "odom.x" in values:
            words.append(f"at {float(values['odom.x']):+.2f} {float(values.get('odom.y', 0.0)):+.2f} m")
        ranges = [(float(v), k) for k, v in values.items() if k.startswith("range.") and not math.isnan(float(v))]
        if ranges:
            metres, key = min(ranges)
            words.append(f"{key[6:]} {metres:.2f} m")
        words += [key for key, value in values.items() if key.startswith(("bump.", "cliff.")) and value is True]
        if "power.level" in values:
            words.append(f"battery {100.0 * float(values['power.level']):.0f} %")
        words.append(f"age {now - newest.t_host:.2f} s")
    return "  ".join(word for word in (*words, controller.message) if word)
