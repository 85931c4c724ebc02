"""Candidate: serial devices of this machine at which a robot may hang; nothing is opened, and no network is asked."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from drivers.registry import built_in_kinds, manifest_of

PATTERNS = ("/dev/ttyUSB*", "/dev/ttyACM*", "/dev/cu.usb*")


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


def lines(found: list[Candidate]) -> list[str]:
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
