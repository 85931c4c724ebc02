"""Gate: a door for tests; what it lets in and allows is written down by the test."""

from __future__ import annotations

from middleware.entangled.record import Slot
from middleware.entangled.wire.door import FOREIGN, NONCE, Authority, Life, OpenDoor

ROOM = 640


class Gate(OpenDoor):
    """Lets in who shows a pass that begins with ``pass``, unless its key is among ``refused``.

    ``forbidden`` are pairs of a public key and a method, ``unwritable`` pairs of a public key and a slot's name.
    """

    fingerprint = b"the team"

    def __init__(self, life: int = 1, nonce: int = 1, shown: bytes = b"pass".ljust(ROOM, b"!")) -> None:
        self.room = ROOM
        self.shown = shown
        self.life = Life(life, bytes([nonce]) * NONCE)
        self.refused: dict[bytes, str] = {}
        self.forbidden: set[tuple[bytes, str]] = set()
        self.unwritable: set[tuple[bytes, str]] = set()
        self.judged: list[bytes] = []

    def judge(self, public: bytes, shown: bytes) -> str:
        self.judged.append(public)
        return self.refused.get(public, "" if shown.startswith(b"pass") else FOREIGN)

    def admit(self, public: bytes, shown: bytes) -> str:
        return self.judge(public, shown)

    def may(self, public: bytes, method: str) -> bool:
        return (public, method) not in self.forbidden

    def may_store(self, slot: Slot) -> bool:
        return (slot.owner, slot.name) not in self.unwritable

    def may_stay(self, slot: Slot) -> bool:
        return self.may_store(slot)

    def authority(self, owner: bytes) -> Authority:
        """As ``judge`` says of who shows a good pass."""
        return Authority(self.refused.get(owner, ""))

    def certificate(self, owner: bytes) -> bytes:
        return self.shown

    def learn(self, owner: bytes, certificate: bytes) -> bool:
        return not self.judge(owner, certificate)
