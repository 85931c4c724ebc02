"""Seal: signed tokens, which any web node of the team makes and knows again without asking another.  Pure.

A token says who it is for, in which role and until when, and is sealed with a key that every web node of the team has;
so no node keeps a list of those who signed in, and a page that goes on with another node need not sign in again.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from dataclasses import dataclass, replace

from webnode.board import Role

ROLES: tuple[Role, ...] = ("viewer", "operator", "phone")
VERSION = 2
HEAD, ID, MAC = 12, 8, 16
MAX_NAME = 64
MAX_TEXT = 4 * (HEAD + ID + 4 * MAX_NAME + MAC)
PERSON = b"swarmweb"


@dataclass(frozen=True)
class Claim:
    """What a token says; ``is_ticket`` that it was made for the query of a GET.

    ``until`` is whole unix seconds, and so is ``limit``, beyond which no token follows this one.
    """

    id: str
    name: str
    role: Role
    until: int
    is_ticket: bool = False
    limit: int = 0

    @property
    def ticket(self) -> Claim:
        """The same, to be seen by more: an operator's ticket lets look only, a phone's is the phone's."""
        return replace(self, role="phone" if self.role == "phone" else "viewer", is_ticket=True)


class Seal:
    """Makes and reads tokens under one secret of 16 to 64 bytes."""

    def __init__(self, secret: bytes) -> None:
        self._key = hashlib.blake2s(hashlib.blake2b(secret, digest_size=32).digest(), person=PERSON).digest()

    def text(self, claim: Claim) -> str:
        """The token; letters, digits, ``-`` and ``_``."""
        head = bytes((VERSION, ROLES.index(claim.role) << 1 | claim.is_ticket))
        head += claim.until.to_bytes(5, "big") + claim.limit.to_bytes(5, "big")
        payload = head + bytes.fromhex(claim.id) + claim.name[:MAX_NAME].encode()
        return base64.urlsafe_b64encode(payload + self._mac(payload)).decode().rstrip("=")

    def claim(self, text: str) -> Claim | None:
        """What a token says, or None where this seal is not on it; whether it has run out the caller sees."""
        if len(text) > MAX_TEXT:
            return None
        try:
            data = base64.b64decode(text.encode("ascii") + b"=" * (-len(text) % 4), b"-_", validate=True)
            payload, mac = data[:-MAC], data[-MAC:]
            if len(payload) < HEAD + ID or not hmac.compare_digest(mac, self._mac(payload)) or payload[0] != VERSION:
                return None
            role = ROLES[payload[1] >> 1]
            name = payload[HEAD + ID :].decode()
        except (ValueError, IndexError, binascii.Error):
            return None
        until, limit = (int.from_bytes(payload[at : at + 5], "big") for at in (2, 7))
        return Claim(payload[HEAD : HEAD + ID].hex(), name, role, until, bool(payload[1] & 1), limit)

    def _mac(self, payload: bytes) -> bytes:
        return hashlib.blake2s(payload, key=self._key, digest_size=MAC, person=PERSON).digest()
