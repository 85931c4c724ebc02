"""CompassDriver: a digital compass that sends NMEA 0183, over the network or on a serial cable.

``compass.heading`` is where the robot's nose points: radians, counter-clockwise from the yard's x axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.base import BaseDriver
from drivers.compass.codec import Heading, SentenceReader
from drivers.compass.option import Options, checked, described
from drivers.driver import Permit
from drivers.errors import LinkLost
from drivers.link import Connector, Line, Link, TcpConnector
from drivers.manifest import Manifest
from drivers.reading import Action, Description

MANIFEST = Manifest("serial", "serial", "on a cable", {"device": "/dev/ttyUSB1"})

HEADING = "compass.heading"
SILENCE_S, LAST_SILENCE_S = 3.0, 24.0
"""Without a heading for so long the link is opened anew; each time twice as long."""
BELIEVED_S = 3.0
"""While the best sentence of a compass is not older, its lesser ones are not believed."""


class CompassDriver(BaseDriver):
    """One compass.

    It has no motors: ``enable`` is always granted while headings come, and of actions there is only ``{}``.
    """

    def __init__(self, options: Options, name: str, connector: Connector, clock: IReactorTime) -> None:
        super().__init__(described(options), name, clock)
        self.STALE_S = max(0.5, 3.0 / options.rate)
        self._options = options
        self._connector = connector
        self._line: Line | None = None
        self._link: Link | None = None
        self._reader = SentenceReader()
        self._best = 0
        self._best_at = -math.inf
        self._bytes_at_start = 0
        self._heard_at = 0.0
        self._silence_s = max(SILENCE_S, 3.0 / options.rate)
        self._timer: Any = None
        self._problem = ""

    @property
    def problem(self) -> str:
        """What keeps the compass from being heard, and the remedy; empty where it is heard."""
        return str(getattr(self._line, "problem", "")) or self._problem

    # -- to the compass ---------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._heard_at = self._clock.seconds()
        self._timer = self._clock.callLater(self._silence_s, self._watch)
        self._line = self._connector.call(*self._options.place, self)

    def _close(self) -> Deferred[None]:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        return succeed(None) if self._line is None else self._line.hang_up()

    def _drive(self, motion: Action, permit: Permit) -> Action:
        return motion  # whoever holds it moves it

    def _switch(self, on: bool) -> Deferred[bool]:
        if self.state == "stale":
            return fail(LinkLost(f"{self._name} is stale; wait for its next heading"))
        return super()._switch(on)

    # -- from the compass -------------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Begin to listen; called by the line."""
        self._link = link
        self._reader = SentenceReader()
        self._bytes_at_start = self._counts["bytes"]
        self._heard_at = self._clock.seconds()

    def link_down(self) -> None:
        """Learn that nothing is heard any more; called by the line."""
        self._link = None
        if self._is_up:
            self._down()

    def received(self, data: bytes) -> None:
        """Take bytes; called by the line."""
        self._counts["bytes"] += len(data)
        bad = self._reader.bad_frames
        for heading in self._reader.read(data):
            if self._is_closed:
                return
            self._on_heading(heading)
        self._counts["bad_frames"] += self._reader.bad_frames - bad

    def _on_heading(self, heading: Heading) -> None:
        now = self._clock.seconds()
        if heading.rank < self._best and now - self._best_at <= BELIEVED_S:
            return
        self._best, self._best_at = heading.rank, now
        self._heard_at = now
        self._silence_s = max(SILENCE_S, 3.0 / self._options.rate)
        self._problem = ""
        self._counts["frames"] += 1
        if not self._is_up:
            self._up()
        # The compass has no clock of its own.
        self._observed({HEADING: self._turned(heading)}, now)

    def _turned(self, heading: Heading) -> float:
        """Degrees clockwise from north as radians counter-clockwise from the x axis, of the robot and not its part."""
        options = self._options
        true = heading.degrees + (0.0 if heading.is_true else options.variation_deg)
        return math.remainder(math.radians(options.x_axis_deg - true - options.mounted_deg), math.tau)

    def _watch(self) -> None:
        silent = self._clock.seconds() - self._heard_at
        if silent < self._silence_s:
            self._timer = self._clock.callLater(self._silence_s - silent, self._watch)
            return
        self._silence_s = min(2.0 * self._silence_s, max(LAST_SILENCE_S, self._silence_s))
        self._heard_at = self._clock.seconds()
        self._timer = self._clock.callLater(self._silence_s, self._watch)
        self._name_problem(self._why())
        if self._link is not None:
            self._link.close()

    def _why(self) -> str:
        place, scale = self._options.place
        if self._link is None:
            is_cable = bool(self._options.device)
            return (
                f"{place} is not open"
                if is_cable
                else f"nothing answers at {place}:{scale}; is it on, and in this network?"
            )
        if self._counts["bytes"] == self._bytes_at_start:
            return "it sends nothing; is it on, and is its output NMEA 0183?"
        if self._reader.sentences:
            return "it sends no heading (HDG, HDM or HDT); is it a compass, and has it settled?"
        return "it sends, but no sentences; " + (
            f"is {scale} baud right?" if self._options.device else "is it NMEA 0183?"
        )

    def _name_problem(self, problem: str) -> None:
        if problem != self._problem:
            self.log.warn("{robot}: {problem}", robot=self._name, problem=problem)
        self._problem = problem


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> CompassDriver:
    """A driver of the compass that ``options`` name."""
    wanted = checked(options)
    if connector is None and wanted.device:
        from drivers.serial import SerialConnector  # a compass on the network is spared it

        connector = SerialConnector()
    return CompassDriver(wanted, name, TcpConnector(says=True) if connector is None else connector, clock)


def describe(options: Mapping[str, object], name: str) -> Description:
    """What that compass is."""
    return described(checked(options))
