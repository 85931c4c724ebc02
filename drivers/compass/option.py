"""Options of the kind "compass": where it is, and how it lies on its robot; checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.errors import UsageError
from drivers.reading import Description

PORT = 10110
"""The TCP port that is registered for NMEA 0183."""
BAUDS = (4800, 9600, 19200, 38400, 57600, 115200)


@dataclass(frozen=True)
class Options:
    """A compass at ``host`` and ``port``, or at the serial ``device`` with ``baud``.

    ``mounted_deg`` is how far its mark is turned to the left of the robot's nose; ``variation_deg`` is what a place's
    magnetic north lies east of true north, for a compass that does not tell; ``x_axis_deg`` is where the yard's x axis
    points, in degrees of a compass.  ``rate`` is how many headings it sends a second.
    """

    host: str = ""
    port: int = PORT
    device: str = ""
    baud: int = 4800
    mounted_deg: float = 0.0
    variation_deg: float = 0.0
    x_axis_deg: float = 90.0
    rate: float = 10.0

    @property
    def place(self) -> tuple[str, int]:
        """What a connector of its sort calls: host and port, or device and baud."""
        return (self.device, self.baud) if self.device else (self.host, self.port)


_NUMBERS: Mapping[str, tuple[float, float, str]] = {
    "mounted_deg": (-360, 360, "degrees that it is turned to the left"),
    "variation_deg": (-180, 180, "degrees, east positive"),
    "x_axis_deg": (0, 360, "degrees clockwise from north"),
    "rate": (0.5, 100, "headings a second"),
}


def checked(table: Mapping[str, object]) -> Options:
    """The options in ``table``; raises ``UsageError`` that names the key and what to write instead."""
    known = ("host", "port", "device", "baud", *_NUMBERS)
    for key, value in table.items():
        if key not in known:
            raise UsageError(f'driver "compass": unknown option {key!r}; known are {", ".join(known)}')
        if key in ("host", "device"):
            if not isinstance(value, str) or not value or not value.isprintable():
                raise _fault(key, value, 'as in host = "192.168.1.31", or device = "/dev/ttyUSB1"')
        elif key == "port":
            if type(value) is not int or not 1 <= value <= 65535:
                raise _fault(key, value, f"from 1 to 65535, as in port = {PORT}")
        elif key == "baud":
            if type(value) is not int or value not in BAUDS:
                raise _fault(key, value, f"one of {', '.join(map(str, BAUDS))}")
        else:
            low, high, unit = _NUMBERS[key]
            if type(value) not in (int, float) or not low <= float(str(value)) <= high:
                raise _fault(key, value, f"{unit} from {low:g} to {high:g}")
    if ("host" in table) == ("device" in table):
        raise UsageError('driver "compass": write either option host (over the network) or device (on a serial cable)')
    return Options(**table)  # type: ignore[arg-type]


def described(options: Options) -> Description:
    """What the compass is; it has no motor, so there is nothing that it can be told to do."""
    return Description("compass", "a compass (NMEA 0183)", {"compass": {}}, {}, 0.05, {"compass": options.rate})


def _fault(key: str, value: object, remedy: str) -> UsageError:
    return UsageError(f'driver "compass": option {key} is {value!r}, but must be {remedy}')
