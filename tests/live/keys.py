"""The keys of the web nodes of ``tests.live.team``, by the name of the node."""

from __future__ import annotations

import hashlib

from middleware.entangled.identity import Identity
from webnode.token import TokenKey

GATEWAYS = ("vaio", "pi")
"""The nodes with the right to sign session tokens."""


def key_of(name: str) -> TokenKey:
    """Return the key of the web node of this name."""
    return TokenKey(Identity(hashlib.blake2s(name.encode()).digest()))
