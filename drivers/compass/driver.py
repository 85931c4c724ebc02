"""CompassDriver: a digital compass that sends NMEA 0183, over the network or on a serial cable.

``compass.heading`` is where the robot's nose points: radians, counter-clockwise from the yard's x axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.base import LinkedDriver, SensingDriver
from drivers.compass.codec import Heading, SentenceReader
from drivers.compass.option import Options, checked, described
from drivers.link import Connector, Link, TcpConnector
from drivers.option import Manifest
from drivers.reading import Description

MANIFEST = Manifest("serial", "serial", "on a cable", {"device": "/dev/ttyUSB1"})

HEADING = "compass.heading"
SILENCE_S, LAST_SILENCE_S = 3.0, 24.0
"""Without a heading for so long the link is opened anew; each time twice as long."""
BELIEVED_S = 3.0
"""While the best sentence of a compass is not older, its lesser ones are not believed."""


class CompassDriver(SensingDriver, LinkedDriver):
    """One compass."""

    def __init__(self, options: Options, name: str, connector: Connector, clock: IReactorTime) -> None:
        super().__init__(described(options), name, clock, connector, options.place)
        self.STALE_S = max(0.5, 3.0 / options.rate)
        self._options = options
        self._reader: SentenceReader = SentenceReader()
        self._best = 0
        self._best_at = -math.inf
        self._bytes_at_start = 0
        self._heard_at = 0.0
        self._silence_s = max(SILENCE_S, 3.0 / options.rate)

    def _open(self) -> None:
        self._heard_at = self._clock.seconds()
        self._timer.set(self._silence_s, self._watch)
        super()._open()

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

    def _heard(self, heading: Heading) -> None:
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
            self._timer.set(self._silence_s - silent, self._watch)
            return
        self._silence_s = min(2.0 * self._silence_s, max(LAST_SILENCE_S, self._silence_s))
        self._heard_at = self._clock.seconds()
        self._timer.set(self._silence_s, self._watch)
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
