"""Parse and write the NMEA 0183 sentences ``HDG``, ``HDM`` and ``HDT`` of any talker, in chunks of any size.

::

    $HCHDG,98.3,0.0,E,12.6,W*57     sensor reading; deviation; variation
    $HCHDM,98.3,M*hh                degrees from magnetic north
    $HCHDT,95.5,T*1B                degrees from true north

Headings are in degrees clockwise from north. Deviation and variation are positive to the east: reading + deviation is
the magnetic heading, magnetic heading + variation is the true heading.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.errors import BadFrame

MAX_LINE_BYTES = 120
"""Maximum length of a sentence in bytes; the standard allows 82."""
RANKS = {"HDM": 1, "HDG": 2, "HDT": 3}
"""The sentences that contain a heading; if a compass sends several, the highest rank is used."""

_DEGREES = re.compile(r"\d{1,3}(\.\d{0,6})?", re.ASCII)


@dataclass(frozen=True)
class Heading:
    """``degrees`` clockwise from north, 0 to 360; from true north if ``is_true``, else from magnetic north."""

    degrees: float
    is_true: bool
    rank: int


class SentenceReader:
    """Extracts headings from a stream; ``sentences`` counts valid sentences, ``bad_frames`` invalid lines.

    After the first sentence with a checksum, sentences that lack a checksum are invalid.
    """

    def __init__(self) -> None:
        self.sentences = 0
        self.bad_frames = 0
        self._rest = b""
        self._is_first = True
        self._has_checksums = False

    def read(self, data: bytes) -> list[Heading]:
        """Return the headings that ``data`` completes."""
        *lines, self._rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        found = []
        for line in filter(None, lines):
            is_first, self._is_first = self._is_first, False
            try:
                heading = self._parse_line(line)
            except BadFrame:
                # The first line of a stream is usually the end of a cut sentence, so it is not counted as invalid.
                self.bad_frames += not is_first
                continue
            self.sentences += 1
            if heading is not None:
                found.append(heading)
        if len(self._rest) > MAX_LINE_BYTES:
            self.bad_frames += 1
            self._rest = b""
        return found

    def _parse_line(self, line: bytes) -> Heading | None:
        body, star, _ = line.partition(b"*")
        if self._has_checksums and not star:
            raise BadFrame("sentence without checksum")
        heading = parse_heading(line)
        self._has_checksums = self._has_checksums or bool(star)
        return heading


def parse_heading(line: bytes) -> Heading | None:
    """Return the heading in a sentence, None if its kind has no heading; raise ``BadFrame`` if invalid or empty."""
    body, star, checksum = line.strip().partition(b"*")
    if len(line) > MAX_LINE_BYTES or not body.startswith((b"$", b"!")) or not body.isascii():
        raise BadFrame("not an NMEA 0183 sentence")
    if star and (len(checksum) != 2 or checksum.upper() != _compute_checksum(body[1:])):
        raise BadFrame("wrong checksum")
    address, *fields = (field.strip() for field in body[1:].decode().split(","))
    kind = address[2:]
    if len(address) != 5 or kind not in RANKS:
        return None
    fields += [""] * 5
    degrees = _parse_degrees(fields[0])
    if kind == "HDG":
        deviation, variation = _parse_angle(*fields[1:3]), _parse_angle(*fields[3:5])
        degrees += (deviation or 0.0) + (variation or 0.0)
        return Heading(degrees % 360.0, variation is not None, RANKS[kind])
    if fields[1] not in ("", kind[2]):
        raise BadFrame(f"{kind} with the reference {fields[1]!r}")
    return Heading(degrees % 360.0, kind == "HDT", RANKS[kind])


def encode_sentence(address: str, *fields: str) -> bytes:
    """Return a sentence with its checksum and line end."""
    body = ",".join((address, *fields)).encode()
    return b"$" + body + b"*" + _compute_checksum(body) + b"\r\n"


def format_angle(degrees: float) -> tuple[str, str]:
    """Return the two fields of an angle that is positive to the east."""
    return f"{abs(degrees):.1f}", "E" if degrees >= 0 else "W"


def _parse_degrees(field: str) -> float:
    if not _DEGREES.fullmatch(field) or float(field) > 360.0:
        raise BadFrame(f"not an angle in degrees: {field!r}")
    return float(field)


def _parse_angle(field: str, side: str) -> float | None:
    """Return the angle of two fields, positive to the east; None if they are empty."""
    if not field and not side:
        return None
    degrees = _parse_degrees(field)
    if degrees > 180.0 or side not in ("E", "W"):
        raise BadFrame(f"not an angle east or west: {field!r}, {side!r}")
    return degrees if side == "E" else -degrees


def _compute_checksum(body: bytes) -> bytes:
    total = 0
    for byte in body:
        total ^= byte
    return b"%02X" % total
