"""An admission check for tests that records each peer that it checks."""

from __future__ import annotations

from middleware.entangled.record import Slot
from middleware.entangled.wire.door import FOREIGN, NONCE, Authority, Life, OpenDoor

ROOM = 640


class Gate(OpenDoor):
    """Admit a peer if its pass begins with ``pass`` and its key is not in ``refused``.

    ``forbidden`` contains pairs of a public key and a method, ``unwritable`` pairs of a public key and the name of a
    slot.
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
        """Return the result of ``judge`` for this owner with a valid pass."""
        return Authority(self.refused.get(owner, ""))

    def certificate(self, owner: bytes) -> bytes:
        return self.shown

    def learn(self, owner: bytes, certificate: bytes) -> bool:
        return not self.judge(owner, certificate)
