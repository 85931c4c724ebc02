"""Codec of compasses: the sentences ``HDG``, ``HDM`` and ``HDT`` of NMEA 0183, of any talker, cut anywhere.

::

    $HCHDG,98.3,0.0,E,12.6,W*57     what the compass reads; its deviation; the variation of the place
    $HCHDM,98.3,M*hh                degrees from magnetic north
    $HCHDT,95.5,T*1B                degrees from true north

Degrees count clockwise from north.  East is added: reading + deviation is magnetic, magnetic + variation is true.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.errors import BadFrame

MOST_LINE = 120
"""Bytes of a sentence; the standard has 82."""
RANKS = {"HDM": 1, "HDG": 2, "HDT": 3}
"""The sentences that tell a heading; of a compass that sends several, the highest is believed."""

_DEGREES = re.compile(r"\d{1,3}(\.\d{0,6})?", re.ASCII)


@dataclass(frozen=True)
class Heading:
    """``degrees`` clockwise from north, 0 to 360; from true north where ``is_true``, else from magnetic north."""

    degrees: float
    is_true: bool
    rank: int


class SentenceReader:
    """The headings in what a compass sends; ``sentences`` counts all that are whole, ``bad_frames`` what is none.

    A compass that has sent a checksum once sends no sentence without.
    """

    def __init__(self) -> None:
        self.sentences = 0
        self.bad_frames = 0
        self._rest = b""
        self._is_first = True
        self._has_checksums = False

    def read(self, data: bytes) -> list[Heading]:
        """The headings that ``data`` completes."""
        *lines, self._rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        found = []
        for line in filter(None, lines):
            is_first, self._is_first = self._is_first, False
            try:
                heading = self._heading(line)
            except BadFrame:
                # Whoever begins to listen hears the end of a sentence first.
                self.bad_frames += not is_first
                continue
            self.sentences += 1
            if heading is not None:
                found.append(heading)
        if len(self._rest) > MOST_LINE:
            self.bad_frames += 1
            self._rest = b""
        return found

    def _heading(self, line: bytes) -> Heading | None:
        body, star, _ = line.partition(b"*")
        if self._has_checksums and not star:
            raise BadFrame("a sentence without its checksum")
        heading = heading_in(line)
        self._has_checksums = self._has_checksums or bool(star)
        return heading


def heading_in(line: bytes) -> Heading | None:
    """What a sentence tells, None for one of another kind; raises ``BadFrame`` for what is none, or tells nothing."""
    body, star, told = line.strip().partition(b"*")
    if len(line) > MOST_LINE or not body.startswith((b"$", b"!")) or not body.isascii():
        raise BadFrame("no sentence")
    if star and (len(told) != 2 or told.upper() != _checksum(body[1:])):
        raise BadFrame("a wrong checksum")
    address, *fields = (field.strip() for field in body[1:].decode().split(","))
    kind = address[2:]
    if len(address) != 5 or kind not in RANKS:
        return None
    fields += [""] * 5
    degrees = _degrees(fields[0])
    if kind == "HDG":
        deviation, variation = _eastward(*fields[1:3]), _eastward(*fields[3:5])
        degrees += (deviation or 0.0) + (variation or 0.0)
        return Heading(degrees % 360.0, variation is not None, RANKS[kind])
    if fields[1] not in ("", kind[2]):
        raise BadFrame(f"{kind} of another north")
    return Heading(degrees % 360.0, kind == "HDT", RANKS[kind])


def sentence(address: str, *fields: str) -> bytes:
    """A sentence with its checksum and its end."""
    body = ",".join((address, *fields)).encode()
    return b"$" + body + b"*" + _checksum(body) + b"\r\n"


def eastward(degrees: float) -> tuple[str, str]:
    """Two fields for an angle that is positive to the east."""
    return f"{abs(degrees):.1f}", "E" if degrees >= 0 else "W"


def _degrees(field: str) -> float:
    if not _DEGREES.fullmatch(field) or float(field) > 360.0:
        raise BadFrame("no degrees")
    return float(field)


def _eastward(field: str, side: str) -> float | None:
    """The angle of two fields, positive to the east; None where they are empty."""
    if not field and not side:
        return None
    degrees = _degrees(field)
    if degrees > 180.0 or side not in ("E", "W"):
        raise BadFrame("neither east nor west")
    return degrees if side == "E" else -degrees


def _checksum(body: bytes) -> bytes:
    total = 0
    for byte in body:
        total ^= byte
    return b"%02X" % total
