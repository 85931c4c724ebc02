"""An admission check for tests, which records the peers that it has checked."""

from __future__ import annotations

from middleware.entangled.record import Slot
from middleware.entangled.wire.admission_check import FOREIGN, NONCE_BYTES, Authority, Incarnation, OpenAdmission

ROOM = 640


class Gate(OpenAdmission):
    """Admit a peer if its credential begins with ``pass`` and its key is not in ``refused``.

    ``forbidden`` contains pairs of a public key and a method, which the owner of the key may not call. ``unwritable``
    contains pairs of a public key and the name of a slot, which the owner of the key may not write.
    """

    fingerprint = b"the team"

    def __init__(self, life: int = 1, nonce: int = 1, shown: bytes = b"pass".ljust(ROOM, b"!")) -> None:
        self.max_pass_bytes = ROOM
        self.own_pass = shown
        self.incarnation = Incarnation(life, bytes([nonce]) * NONCE_BYTES)
        self.refused: dict[bytes, str] = {}
        self.forbidden: set[tuple[bytes, str]] = set()
        self.unwritable: set[tuple[bytes, str]] = set()
        self.judged: list[bytes] = []

    def find_refusal(self, public: bytes, shown: bytes) -> str:
        self.judged.append(public)
        return self.refused.get(public, "" if shown.startswith(b"pass") else FOREIGN)

    def admit(self, public: bytes, shown: bytes) -> str:
        return self.find_refusal(public, shown)

    def may_call(self, public: bytes, method: str) -> bool:
        return (public, method) not in self.forbidden

    def may_store(self, slot: Slot) -> bool:
        return (slot.owner, slot.name) not in self.unwritable

    def may_keep(self, slot: Slot) -> bool:
        return self.may_store(slot)

    def find_authority(self, owner: bytes) -> Authority:
        """Return the authority of this owner, as if the owner had a valid credential."""
        return Authority(self.refused.get(owner, ""))

    def find_certificate(self, owner: bytes) -> bytes:
        return self.own_pass

    def add_certificate(self, owner: bytes, certificate: bytes) -> bool:
        return not self.find_refusal(owner, certificate)
