"""Options of the kind "compass": where it is, and how it lies on its robot; checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from drivers.errors import UsageError
from drivers.option import Port, convert_options
from drivers.reading import Description
from formats.convert import LINE, Unit

PORT = 10110
"""The TCP port that is registered for NMEA 0183."""
Baud = Literal[4800, 9600, 19200, 38400, 57600, 115200]


@dataclass(frozen=True)
class Options:
    """A compass at ``host`` and ``port``, or at the serial ``device`` with ``baud``.

    ``mounted_deg`` is how far its mark is turned to the left of the robot's nose; ``variation_deg`` is what a place's
    magnetic north lies east of true north, for a compass that does not tell; ``x_axis_deg`` is where the yard's x axis
    points, in degrees of a compass.  ``rate`` is how many headings it sends a second.
    """

    host: Annotated[str, Meta(min_length=1, examples=["192.168.1.31"]), LINE] = ""
    port: Port = PORT
    device: Annotated[str, Meta(min_length=1, examples=["/dev/ttyUSB1"]), LINE] = ""
    baud: Baud = 4800
    mounted_deg: Annotated[float, Meta(ge=-360, le=360), Unit("degrees to the left")] = 0.0
    variation_deg: Annotated[float, Meta(ge=-180, le=180), Unit("degrees to the east")] = 0.0
    x_axis_deg: Annotated[float, Meta(ge=0, le=360), Unit("degrees clockwise from north")] = 90.0
    rate: Annotated[float, Meta(ge=0.5, le=100), Unit("headings a second")] = 10.0

    @property
    def place(self) -> tuple[str, int]:
        """What a connector of its sort calls: host and port, or device and baud."""
        return (self.device, self.baud) if self.device else (self.host, self.port)


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    options = convert_options("compass", table, Options)
    if bool(options.host) == bool(options.device):
        raise UsageError('driver "compass": write either option host (over the network) or device (on a serial cable)')
    return options


def described(options: Options) -> Description:
    """What the compass is; it has no motor, so there is nothing that it can be told to do."""
    return Description("compass", "a compass (NMEA 0183)", {"compass": {}}, {}, 0.05, {"compass": options.rate})
