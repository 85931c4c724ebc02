"""Classify the path to a peer in terms that operators know."""

from __future__ import annotations

from typing import Literal, NamedTuple

from middleware.entangled.nat.candidate import is_loopback, is_near
from middleware.entangled.network.network import Address, is_relayed

PathKind = Literal["none", "machine", "lan", "direct", "punched", "carried", "tunnel"]
PATH_KINDS: tuple[PathKind, ...] = ("none", "machine", "lan", "direct", "punched", "carried", "tunnel")


class PeerPath(NamedTuple):
    """The path to one peer.

    ``kind`` is ``machine`` (the same machine), ``lan``, ``direct`` (through the internet without help), ``punched``
    (opened by hole punching), ``carried`` (relayed), ``tunnel`` (TLS, if UDP is blocked) or ``none``.  ``by`` is the id
    of the relay of a ``carried`` path, empty if there is currently no relay.  ``since`` is the time since which the
    path has had this kind; None if ``kind`` is ``none``.
    """

    kind: PathKind
    address: Address | None = None
    by: bytes = b""
    since: float | None = None


def classify_path(address: Address, own: Address, is_translated: bool, was_introduced: bool) -> PathKind:
    """Return the kind of the path to a peer at ``address``, to which datagrams are sent from ``own``."""
    if is_relayed(address):
        return "carried"
    if address.is_virtual:
        return "tunnel"
    if is_loopback(address.host) or address.host == own.host:
        return "machine"
    if is_near(address.host, own.host, is_translated):
        return "lan"
    return "punched" if was_introduced else "direct"
