"""Options of the kind "compass": its address and its mounting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from drivers.errors import UsageError
from drivers.option import Port, convert_options
from drivers.reading import Description
from formats.convert import PRINTABLE, Unit

NMEA_PORT = 10110
"""The TCP port that is registered for NMEA 0183."""
Baud = Literal[4800, 9600, 19200, 38400, 57600, 115200]


@dataclass(frozen=True)
class Options:
    """A compass at ``host`` and ``port``, or at the serial ``device`` with ``baud``.

    ``mounted_deg`` is the angle by which the mark on the compass points to the left of the robot's front.
    ``variation_deg`` is the angle by which magnetic north is east of true north, for a compass that does not send the
    variation. ``x_axis_deg`` is the direction of the map's x axis in degrees clockwise from north.  ``rate`` is the
    number of headings per second that it sends.
    """

    host: Annotated[str, Meta(min_length=1, examples=["192.168.1.31"]), PRINTABLE] = ""
    port: Port = NMEA_PORT
    device: Annotated[str, Meta(min_length=1, examples=["/dev/ttyUSB1"]), PRINTABLE] = ""
    baud: Baud = 4800
    mounted_deg: Annotated[float, Meta(ge=-360, le=360), Unit("degrees to the left")] = 0.0
    variation_deg: Annotated[float, Meta(ge=-180, le=180), Unit("degrees to the east")] = 0.0
    x_axis_deg: Annotated[float, Meta(ge=0, le=360), Unit("degrees clockwise from north")] = 90.0
    rate: Annotated[float, Meta(ge=0.5, le=100), Unit("headings a second")] = 10.0

    @property
    def endpoint(self) -> tuple[str, int]:
        """The arguments of the connector: host and port, or device and baud rate."""
        return (self.device, self.baud) if self.device else (self.host, self.port)


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    options = convert_options("compass", table, Options)
    if bool(options.host) == bool(options.device):
        raise UsageError('driver "compass": write either option host (over the network) or device (on a serial cable)')
    return options


def make_description(options: Options) -> Description:
    """Return the description of the compass, which has no motors and therefore no actions."""
    return Description("compass", "a compass (NMEA 0183)", {"compass": {}}, {}, 0.05, {"compass": options.rate})
