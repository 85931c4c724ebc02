"""Compute the XOR metric of 160-bit ids (Kademlia, section 2.1)."""

from __future__ import annotations

from collections.abc import Iterable

from middleware.entangled.contact import Contact


def distance(a: bytes, b: bytes) -> int:
    """Return the exclusive or of two ids as a number; 0 if they are equal."""
    return int.from_bytes(a) ^ int.from_bytes(b)


def bucket_index(own: bytes, other: bytes) -> int:
    """Return the index i of the k-bucket for distances from 2**i to below 2**(i+1).

    Raises ``ValueError`` if the ids are equal.
    """
    apart = distance(own, other)
    if not apart:
        raise ValueError("a node has no bucket for itself")
    return apart.bit_length() - 1


def select_closest(contacts: Iterable[Contact], target: bytes, count: int) -> list[Contact]:
    """Return at most ``count`` of ``contacts``, the closest to ``target`` first; equal ids keep their order."""
    goal = int.from_bytes(target)
    return sorted(contacts, key=lambda contact: int.from_bytes(contact.node_id) ^ goal)[:count]
