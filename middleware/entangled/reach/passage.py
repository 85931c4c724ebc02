"""Passage: by which way a peer is reached, in a word that people know; pure."""

from __future__ import annotations

from typing import Literal, NamedTuple

from middleware.entangled.network.network import Address, is_relayed
from middleware.entangled.reach.candidate import is_loopback, is_near

Kind = Literal["none", "machine", "lan", "direct", "punched", "carried", "tunnel"]
KINDS: tuple[Kind, ...] = ("none", "machine", "lan", "direct", "punched", "carried", "tunnel")


class Passage(NamedTuple):
    """The way to one peer.

    ``kind`` is ``machine`` (this one), ``lan``, ``direct`` (through the internet, and nobody helps), ``punched``
    (routers were opened by an introduction), ``carried`` (by the node whose id is ``by``; empty: nobody does now),
    ``tunnel`` (TLS, where no datagram passes) or ``none``.  ``since`` is the moment from which it is that way, None
    with ``none``.
    """

    kind: Kind
    address: Address | None = None
    by: bytes = b""
    since: float | None = None


def kind_of(address: Address, own: Address, is_translated: bool, was_introduced: bool) -> Kind:
    """What a session with a peer at ``address`` goes by; datagrams to it leave from ``own``."""
    if is_relayed(address):
        return "carried"
    if address.is_virtual:
        return "tunnel"
    if is_loopback(address.host) or address.host == own.host:
        return "machine"
    if is_near(address.host, own.host, is_translated):
        return "lan"
    return "punched" if was_introduced else "direct"
