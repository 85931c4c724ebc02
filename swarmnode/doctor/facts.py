"""Facts: what was measured around one node, and what was found in it; a fact that could not be measured is None."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import ip_address
from typing import Literal

from middleware.entangled.network.interface import Interface
from middleware.entangled.network.network import Address
from middleware.entangled.wire.hail import VERSION

Weight = Literal["error", "warning", "note"]
ORDER: tuple[Weight, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Answer:
    """What somebody who was hailed said; ``offset`` is its clock less this one, in seconds."""

    address: Address
    version: int = VERSION
    fingerprint: bytes = bytes(8)
    offset: float | None = None
    seen: Address | None = None


@dataclass(frozen=True)
class Probe:
    """One node that the settings name, asked over UDP.

    ``answer`` is its ECHO; ``is_member`` says that it answered a WHO of this team, too.  ``error`` is ``refused`` where
    the machine said that nobody listens, ``unreachable`` where there is no way to it.  ``is_near``: it is of a subnet
    of this machine; ``is_resolved``: its hardware answers there.  ``is_tcp``: it answers to TCP, if only by a refusal.
    """

    address: Address
    answer: Answer | None = None
    is_member: bool = False
    error: str = ""
    is_near: bool = False
    is_resolved: bool | None = None
    is_tcp: bool | None = None

    @property
    def is_heard(self) -> bool:
        """Whether anything came back over UDP."""
        return self.answer is not None or self.is_member


@dataclass(frozen=True)
class Lan:
    """The group of the LAN: who answered a HAIL to it, and whether this machine heard its own."""

    answers: tuple[Answer, ...] = ()
    is_sent: bool = False
    is_own_heard: bool = False


@dataclass(frozen=True)
class Certificate:
    """What the node's membership says; the moments are unix seconds.  ``problem``: why it cannot be read."""

    not_before: float = 0.0
    not_after: float = float("inf")
    problem: str = ""


@dataclass(frozen=True)
class Storage:
    """The store's file: whether it can be written, and the free bytes of its disk."""

    path: str
    problem: str = ""
    free: int | None = None


@dataclass(frozen=True)
class Health:
    """What the running node says of itself; ``refusals`` are the names of those that it met, with whom."""

    contacts: int
    rows: int = 0
    max_rows: int = 0
    bytes: int = 0
    max_bytes: int = 0
    trouble: str = ""
    refusals: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Facts:
    """Everything about one node and its surroundings; ``wall`` is this machine's clock, in unix seconds."""

    name: str
    host: str
    port: int
    wall: float
    interfaces: tuple[Interface, ...] = ()
    known: tuple[Probe, ...] = ()
    lan: Lan | None = None
    port_problem: str = ""
    is_running: bool = False
    fingerprint: bytes = bytes(8)
    way_out: str = ""
    """From which of its addresses this machine reaches the known nodes."""
    is_gateway_resolved: bool | None = None
    certificate: Certificate | None = None
    storage: Storage | None = None
    open_files: tuple[tuple[str, int], ...] = ()
    """Files with secrets that others than their owner can read, with their modes."""
    health: Health | None = None

    @property
    def answers(self) -> tuple[Answer, ...]:
        """All who said anything, the known nodes first; each address once."""
        found = [probe.answer for probe in self.known if probe.answer is not None]
        found += [] if self.lan is None else list(self.lan.answers)
        return tuple({answer.address: answer for answer in reversed(found)}.values())[::-1]

    @property
    def own(self) -> frozenset[str]:
        """The addresses of this machine."""
        return frozenset(address for interface in self.interfaces for address in interface.addresses)

    @property
    def others(self) -> tuple[Answer, ...]:
        """Those on the LAN that are not on this machine."""
        return () if self.lan is None else tuple(a for a in self.lan.answers if a.address.host not in self.own)


def is_local(host: str) -> bool:
    """Whether ``host`` is heard on one machine alone."""
    try:
        return ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Finding:
    """``cause`` is a name for programs, such as ``udp-blocked``; the rest are sentences for people.

    An ``error`` keeps the node from its team, a ``warning`` will or may, a ``note`` is good to know.
    """

    weight: Weight
    cause: str
    what: str
    why: str
    remedy: str


def error(cause: str, what: str, why: str, remedy: str) -> Finding:
    """What keeps the node from its team."""
    return Finding("error", cause, what, why, remedy)


def warning(cause: str, what: str, why: str, remedy: str) -> Finding:
    """What may keep it, or will."""
    return Finding("warning", cause, what, why, remedy)


def note(cause: str, what: str, why: str, remedy: str) -> Finding:
    """What is good to know."""
    return Finding("note", cause, what, why, remedy)
