"""Driver of a digital compass that sends NMEA 0183, over the network or on a serial cable.

``compass.heading`` is the heading of the robot in radians, counter-clockwise from the map's x axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.base import LinkedDriver, SensingDriver
from drivers.compass.codec import Heading, SentenceReader
from drivers.compass.option import Options, make_description, parse_options
from drivers.link import Connector, Link, TcpConnector
from drivers.option import Manifest
from drivers.reading import Description

MANIFEST = Manifest("serial", "serial", "on a cable", {"device": "/dev/ttyUSB1"})

HEADING = "compass.heading"
SILENCE_S, MAX_SILENCE_S = 3.0, 24.0
"""Seconds without a heading after which the link is reopened: initial and maximum value, doubled each time."""
RANK_HOLD_S = 3.0
"""Seconds for which sentences of a lower rank are ignored after one of the best rank."""


class CompassDriver(SensingDriver, LinkedDriver):
    """One compass."""

    def __init__(self, options: Options, name: str, connector: Connector, clock: IReactorTime) -> None:
        super().__init__(make_description(options), name, clock, connector, options.endpoint)
        self.STALE_S = max(0.5, 3.0 / options.rate)
        self._options = options
        self._reader: SentenceReader = SentenceReader()
        self._best_rank = 0
        self._best_at = -math.inf
        self._bytes_at_start = 0
        self._last_data_at = 0.0
        self._silence_s = max(SILENCE_S, 3.0 / options.rate)

    def _open(self) -> None:
        self._last_data_at = self._clock.seconds()
        self._timer.set(self._silence_s, self._check_silence)
        super()._open()

    # -- from the compass -------------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Start to read; called by the link."""
        self._link = link
        self._reader = SentenceReader()
        self._bytes_at_start = self._counts["bytes"]
        self._last_data_at = self._clock.seconds()

    def link_down(self) -> None:
        """Handle the loss of the link; called by the link."""
        self._link = None
        if self._is_up:
            self._down()

    def _on_message(self, heading: Heading) -> None:
        now = self._clock.seconds()
        if heading.rank < self._best_rank and now - self._best_at <= RANK_HOLD_S:
            return
        self._best_rank, self._best_at = heading.rank, now
        self._last_data_at = now
        self._silence_s = max(SILENCE_S, 3.0 / self._options.rate)
        self._problem = ""
        self._counts["frames"] += 1
        if not self._is_up:
            self._up()
        # The compass sends no time stamps, so the time of arrival is used.
        self._observed({HEADING: self._convert_heading(heading)}, now)

    def _convert_heading(self, heading: Heading) -> float:
        """Convert degrees clockwise from north to the robot's heading in radians counter-clockwise from the x axis."""
        options = self._options
        true = heading.degrees + (0.0 if heading.is_true else options.variation_deg)
        return math.remainder(math.radians(options.x_axis_deg - true - options.mounted_deg), math.tau)

    def _check_silence(self) -> None:
        silent = self._clock.seconds() - self._last_data_at
        if silent < self._silence_s:
            self._timer.set(self._silence_s - silent, self._check_silence)
            return
        self._silence_s = min(2.0 * self._silence_s, max(MAX_SILENCE_S, self._silence_s))
        self._last_data_at = self._clock.seconds()
        self._timer.set(self._silence_s, self._check_silence)
        self._set_problem(self._describe_silence())
        if self._link is not None:
            self._link.close()

    def _describe_silence(self) -> str:
        endpoint, scale = self._options.endpoint
        if self._link is None:
            is_cable = bool(self._options.device)
            return (
                f"{endpoint} is not open"
                if is_cable
                else f"nothing answers at {endpoint}:{scale}; is the compass switched on, and in this network?"
            )
        if self._counts["bytes"] == self._bytes_at_start:
            return "the compass sends nothing; is it switched on, and is its output NMEA 0183?"
        if self._reader.sentences:
            return "the device sends no heading (HDG, HDM or HDT); is it a compass, and has it settled?"
        return "the device sends data, but no sentences; " + (
            f"is {scale} baud right?" if self._options.device else "is it NMEA 0183?"
        )


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> CompassDriver:
    """Return a driver of the compass at the address in ``options``."""
    wanted = parse_options(options)
    if connector is None and wanted.device:
        from drivers.serial import SerialConnector  # not needed for a compass on the network

        connector = SerialConnector()
    return CompassDriver(wanted, name, TcpConnector(says=True) if connector is None else connector, clock)


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the compass that ``options`` select."""
    return make_description(parse_options(options))
