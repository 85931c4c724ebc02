"""Catalogue: the kinds of robot that there are drivers for, and the serial devices at which one may hang.

Nothing is opened, and no network is asked.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

from drivers.errors import UsageError
from drivers.registry import built_in_kinds, kinds, maker, manifest_of, places

PATTERNS = ("/dev/ttyUSB*", "/dev/ttyACM*", "/dev/cu.usb*")


@dataclass(frozen=True)
class Entry:
    """One kind; ``is_ready`` where nothing has to be installed first, ``problem`` where it cannot be loaded."""

    kind: str
    about: str
    needs: str = ""
    is_ready: bool = True
    problem: str = ""


def catalogue(is_there: Callable[[str], bool] = lambda library: find_spec(library) is not None) -> list[Entry]:
    """Every kind there is; a broken one of another distribution is told as such, and the others are as they are."""
    built_in, foreign = built_in_kinds(), places()
    return [
        _built_in(kind, is_there) if kind in built_in else _foreign(kind, foreign[kind])
        for kind in kinds()
        if kind in built_in or kind in foreign
    ]


def catalogue_lines(entries: list[Entry]) -> list[str]:
    """The catalogue for a person."""
    width = max((len(entry.kind) for entry in entries), default=0)
    told = []
    for entry in entries:
        told.append(f"{entry.kind:{width}}  {entry.problem or entry.about}")
        if entry.needs:
            told.append(f"{'':{width}}  {entry.needs}")
    return told


def _built_in(kind: str, is_there: Callable[[str], bool]) -> Entry:
    package = import_module(f"drivers.{kind}")
    about = (package.__doc__ or "").strip().split("\n")[0].partition(": ")[0].rstrip(".")
    manifest = manifest_of(kind)
    if not manifest.library or is_there(manifest.library):
        return Entry(kind, about)
    return Entry(
        kind, about, f"pip install 'swarm-node[{manifest.extra}]'{manifest.when and ', ' + manifest.when}", False
    )


def _foreign(kind: str, place: str) -> Entry:
    try:
        made: object = getattr(maker(kind, place), "args", (kind, None))[1]
    except UsageError as error:
        return Entry(kind, "", "", False, f"broken: {error}")
    about = (getattr(made, "__doc__", None) or "").strip().split("\n")[0].rstrip(".")
    return Entry(kind, f"{about or 'a driver of another distribution'} ({place})")


@dataclass(frozen=True)
class Candidate:
    """A serial device; ``about`` is what its plug says of itself."""

    device: str
    about: str
    is_allowed: bool


def candidates(
    ports: Callable[[], Iterable[tuple[str, str]]] | None = None, may: Callable[[str], bool] | None = None
) -> list[Candidate]:
    """The serial devices that there are, with pyserial's knowledge of them where that is installed."""
    may = may or (lambda device: os.access(device, os.R_OK | os.W_OK))
    return [Candidate(device, about, may(device)) for device, about in sorted((ports or serial_ports)())]


def serial_ports() -> list[tuple[str, str]]:
    """Each serial device and what it is; the ports that a board merely could have are left out."""
    try:
        from serial.tools.list_ports import comports
    except ImportError:
        return [(device, "") for pattern in PATTERNS for device in glob.glob(pattern)]
    return [(port.device, _about(port)) for port in comports() if port.hwid != "n/a"]


def candidate_lines(found: list[Candidate]) -> list[str]:
    """What was found, and how to go on."""
    if not found:
        return [
            "no serial device is plugged in",
            "a robot in the network is asked only where it is named, as in:",
            "  swarm driver probe --kind aibo --option host=192.168.0.51",
        ]
    told = []
    for each in found:
        told.append(f"{each.device}  {each.about}".rstrip())
        if not each.is_allowed:
            told.append("  no permission; add this user to the device's group (often dialout), and sign in anew")
        told += [f"  swarm driver probe --kind {kind} --option port={each.device}" for kind in cable_kinds()]
    return told


def cable_kinds() -> list[str]:
    """Return the kinds that hang on a cable; nothing tells from outside which of them a device is."""
    return [kind for kind in built_in_kinds() if manifest_of(kind).is_on_cable]


def _about(port: object) -> str:
    words = [str(getattr(port, name, None) or "") for name in ("manufacturer", "description")]
    return " ".join(word for word in words if word and word != "n/a")
