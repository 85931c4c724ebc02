"""Kinds of robots with drivers, and serial devices of this machine.

No device is opened, and no network is accessed.
"""

from __future__ import annotations

import errno
import glob
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

from drivers.errors import UsageError
from drivers.registry import list_built_in_kinds, list_entry_points, list_kinds, load_factory, load_manifest
from drivers.serial import PROBLEMS

DEVICE_PATTERNS = ("/dev/ttyUSB*", "/dev/ttyACM*", "/dev/cu.usb*")


@dataclass(frozen=True)
class KindEntry:
    """One kind of robot; ``is_ready`` is whether nothing has to be installed.

    ``problem`` is the reason why the driver cannot be loaded.
    """

    kind: str
    about: str
    needs: str = ""
    is_ready: bool = True
    problem: str = ""


def list_kind_entries(
    is_there: Callable[[str], bool] = lambda library: find_spec(library) is not None,
) -> list[KindEntry]:
    """Return every kind of robot; a broken driver of another distribution is listed with its problem."""
    built_in, installed = list_built_in_kinds(), list_entry_points()
    return [
        _make_built_in_entry(kind, is_there) if kind in built_in else _make_installed_entry(kind, installed[kind])
        for kind in list_kinds()
        if kind in built_in or kind in installed
    ]


def format_kind_entries(entries: list[KindEntry]) -> list[str]:
    """Return the catalogue as lines of text."""
    width = max((len(entry.kind) for entry in entries), default=0)
    lines = []
    for entry in entries:
        lines.append(f"{entry.kind:{width}}  {entry.problem or entry.about}")
        if entry.needs:
            lines.append(f"{'':{width}}  {entry.needs}")
    return lines


def _make_built_in_entry(kind: str, is_there: Callable[[str], bool]) -> KindEntry:
    package = import_module(f"drivers.{kind}")
    about = (package.__doc__ or "").strip().split("\n")[0].partition(": ")[0].rstrip(".")
    manifest = load_manifest(kind)
    if not manifest.library or is_there(manifest.library):
        return KindEntry(kind, about)
    return KindEntry(
        kind, about, f"pip install 'swarm-node[{manifest.extra}]'{manifest.when and ', ' + manifest.when}", False
    )


def _make_installed_entry(kind: str, place: str) -> KindEntry:
    try:
        factory: object = getattr(load_factory(kind, place), "args", (kind, None))[1]
    except UsageError as error:
        return KindEntry(kind, "", "", False, f"broken: {error}")
    about = (getattr(factory, "__doc__", None) or "").strip().split("\n")[0].rstrip(".")
    return KindEntry(kind, f"{about or 'a driver of another distribution'} ({place})")


@dataclass(frozen=True)
class SerialDevice:
    """A serial device; ``about`` is the description by its plug."""

    device: str
    about: str
    is_allowed: bool


def list_serial_devices(
    ports: Callable[[], Iterable[tuple[str, str]]] | None = None, may: Callable[[str], bool] | None = None
) -> list[SerialDevice]:
    """Return the serial devices, with their descriptions if pyserial is installed."""
    may = may or (lambda device: os.access(device, os.R_OK | os.W_OK))
    return [SerialDevice(device, about, may(device)) for device, about in sorted((ports or list_serial_ports)())]


def list_serial_ports() -> list[tuple[str, str]]:
    """Return each serial device with its description, without unused ports of the board."""
    try:
        from serial.tools.list_ports import comports
    except ImportError:
        return [(device, "") for pattern in DEVICE_PATTERNS for device in glob.glob(pattern)]
    return [(port.device, _describe_port(port)) for port in comports() if port.hwid != "n/a"]


def format_serial_devices(found: list[SerialDevice]) -> list[str]:
    """Return the devices found, with the next command for each, as lines of text."""
    if not found:
        return [
            "no serial device is plugged in",
            "a robot in the network needs its address, for example:",
            "  swarm driver probe --kind aibo --option host=192.168.0.51",
        ]
    lines = []
    for each in found:
        lines.append(f"{each.device}  {each.about}".rstrip())
        if not each.is_allowed:
            lines.append(f"  {PROBLEMS[errno.EACCES]}")
        lines += [f"  swarm driver probe --kind {kind} --option port={each.device}" for kind in list_cable_kinds()]
    return lines


def list_cable_kinds() -> list[str]:
    """Return the kinds of robots with a cable; a serial device does not show the kind of its robot."""
    return [kind for kind in list_built_in_kinds() if load_manifest(kind).is_on_cable]


def _describe_port(port: object) -> str:
    words = [str(getattr(port, name, None) or "") for name in ("manufacturer", "description")]
    return " ".join(word for word in words if word and word != "n/a")
