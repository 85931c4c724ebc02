"""The measurements that ``swarm doctor`` judges; a fact that could not be measured is None."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import ip_address
from typing import Literal

from middleware.entangled.network.interface import Interface
from middleware.entangled.network.network import Address
from middleware.entangled.wire.probe import VERSION

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Answer:
    """The reply of a node to a discovery probe; ``offset`` is its clock minus this machine's, in seconds."""

    address: Address
    version: int = VERSION
    fingerprint: bytes = bytes(8)
    offset: float | None = None
    seen: Address | None = None


@dataclass(frozen=True)
class Probe:
    """The result of probing one known node over UDP.

    ``answer`` is its reply to a PROBE; ``is_member`` means that it also replied to a DISCOVERY of this team. ``error``
    is ``refused`` if the machine reported a closed port, ``unreachable`` if there is no route.  ``is_near`` is whether
    the node is in a subnet of this machine, and ``is_resolved`` whether its hardware address was resolved. ``is_tcp``
    is whether its machine replies to TCP, even if only with a refusal.
    """

    address: Address
    answer: Answer | None = None
    is_member: bool = False
    error: str = ""
    is_near: bool = False
    is_resolved: bool | None = None
    is_tcp: bool | None = None

    @property
    def has_reply(self) -> bool:
        """Whether any UDP reply was received."""
        return self.answer is not None or self.is_member


@dataclass(frozen=True)
class LanDiscovery:
    """Discovery on the LAN: the replies to a multicast probe, and whether this machine received its own probe."""

    answers: tuple[Answer, ...] = ()
    is_sent: bool = False
    has_received_own: bool = False


@dataclass(frozen=True)
class Certificate:
    """The dates of the node's certificate, as Unix timestamps; ``problem`` is the reason why it cannot be read."""

    not_before: float = 0.0
    not_after: float = float("inf")
    problem: str = ""


@dataclass(frozen=True)
class Storage:
    """The file of the store: the reason why it is not writable, and the free bytes of its disk."""

    path: str
    problem: str = ""
    free: int | None = None


@dataclass(frozen=True)
class Health:
    """Self-report of the running node; ``refusals`` are pairs of a refusal and the peer that sent it."""

    contacts: int
    rows: int = 0
    max_rows: int = 0
    bytes: int = 0
    max_bytes: int = 0
    trouble: str = ""
    refusals: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Facts:
    """All facts about one node and its environment; ``wall`` is this machine's clock, as a Unix timestamp."""

    name: str
    host: str
    port: int
    wall: float
    interfaces: tuple[Interface, ...] = ()
    known: tuple[Probe, ...] = ()
    lan: LanDiscovery | None = None
    port_problem: str = ""
    is_running: bool = False
    fingerprint: bytes = bytes(8)
    source_address: str = ""
    """The address from which this machine reaches the known nodes."""
    is_gateway_resolved: bool | None = None
    certificate: Certificate | None = None
    storage: Storage | None = None
    open_files: tuple[tuple[str, int], ...] = ()
    """Files with secrets that other users can read, with their modes."""
    health: Health | None = None

    @property
    def answers(self) -> tuple[Answer, ...]:
        """All replies, first the replies of known nodes; an address is listed once."""
        found = [probe.answer for probe in self.known if probe.answer is not None]
        found += [] if self.lan is None else list(self.lan.answers)
        return tuple({answer.address: answer for answer in reversed(found)}.values())[::-1]

    @property
    def own_addresses(self) -> frozenset[str]:
        """The addresses of this machine."""
        return frozenset(address for interface in self.interfaces for address in interface.addresses)

    @property
    def other_answers(self) -> tuple[Answer, ...]:
        """The replies on the LAN from other machines."""
        return (
            () if self.lan is None else tuple(a for a in self.lan.answers if a.address.host not in self.own_addresses)
        )


def is_local(host: str) -> bool:
    """Return whether ``host`` is a loopback address."""
    try:
        return ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Finding:
    """A problem or a note; ``cause`` is a code such as ``udp-blocked``, the other fields are sentences for display.

    An ``error`` prevents the node from reaching its team, a ``warning`` may do so, a ``note`` is information.
    """

    weight: Severity
    cause: str
    what: str
    why: str
    remedy: str


def make_error(cause: str, what: str, why: str, remedy: str) -> Finding:
    """Return a problem that prevents the node from reaching its team."""
    return Finding("error", cause, what, why, remedy)


def make_warning(cause: str, what: str, why: str, remedy: str) -> Finding:
    """Return a problem that may prevent the node from reaching its team."""
    return Finding("warning", cause, what, why, remedy)


def make_note(cause: str, what: str, why: str, remedy: str) -> Finding:
    """Return information without a problem."""
    return Finding("note", cause, what, why, remedy)
