"""Session: two directional keys, a counter as nonce, and a window against replays.

A DATA datagram is: type (1), the receiver's index of the session (4), counter (8), then the sealed message with its tag
(16): 29 bytes more than the message.  The 13 bytes in front are authenticated too.
"""

from __future__ import annotations

from middleware.entangled.errors import Forged
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import MAX_DATAGRAM
from middleware.entangled.wire.noise import TAG, TransportKeys, opened, sealed

DATA = 0x13
INDEX_BYTES = 4
_HEADER = 1 + INDEX_BYTES + 8
OVERHEAD = _HEADER + TAG
MAX_MESSAGE = MAX_DATAGRAM - OVERHEAD
WINDOW = 1024
_WINDOW_MASK = (1 << WINDOW) - 1


class Session:
    """One agreed pair of keys with one peer.

    ``local_index`` is the number under which we find the session, ``remote_index`` the one under which the peer does.
    ``contact`` is the peer with the address from which its newest datagram came.  ``is_confirmed`` says that the peer
    has shown to hold the keys at that address; until then nothing may be sent.  Moments are seconds of the endpoint's
    clock.
    """

    __slots__ = (
        "contact",
        "local_index",
        "remote_index",
        "is_confirmed",
        "opened_at",
        "heard_at",
        "_sending",
        "_receiving",
        "_sent",
        "_highest",
        "_seen",
        "_header",
    )

    def __init__(
        self, contact: Contact, local_index: int, remote_index: int, keys: TransportKeys, now: float, is_confirmed: bool
    ) -> None:
        self.contact = contact
        self.local_index = local_index
        self.remote_index = remote_index
        self.is_confirmed = is_confirmed
        self.opened_at = now
        self.heard_at = now
        self._sending = keys.sending
        self._receiving = keys.receiving
        self._sent = 0
        self._highest = -1
        self._seen = 0  # bit n: the counter n below the highest has been here
        self._header = bytes([DATA]) + remote_index.to_bytes(INDEX_BYTES, "little")

    def seal(self, message: bytes) -> bytes:
        """The next DATA datagram, with ``message`` of at most ``MAX_MESSAGE`` bytes inside."""
        counter = self._sent
        self._sent = counter + 1
        header = self._header + counter.to_bytes(8, "little")
        return header + sealed(self._sending, counter, message, header)

    def is_replay(self, datagram: bytes) -> bool:
        """Whether the counter of a DATA datagram has been here, or is too old to tell; costs no decryption."""
        behind = self._highest - int.from_bytes(datagram[5:_HEADER], "little")
        return behind >= 0 and (behind >= WINDOW or bool(self._seen >> behind & 1))

    def open(self, datagram: bytes) -> tuple[bytes, bool]:
        """The message inside a DATA datagram, and whether it is the newest so far.

        Raises ``Forged`` where the datagram does not open or was here before; the session is then as it was.
        """
        if len(datagram) < OVERHEAD or self.is_replay(datagram):
            raise Forged("a datagram that was here before, or is too short")
        header = datagram[:_HEADER]
        counter = int.from_bytes(header[5:], "little")
        message = opened(self._receiving, counter, datagram[_HEADER:], header)
        ahead = counter - self._highest
        if ahead > 0:
            # A counter may leap by up to 2**64: shifting by more than the window would only cost memory.
            self._seen = ((self._seen << ahead) & _WINDOW_MASK if ahead < WINDOW else 0) | 1
            self._highest = counter
        else:
            self._seen |= 1 << -ahead
        return message, ahead > 0


def index_of(datagram: bytes) -> int:
    """The receiver's session index in a DATA or RESP datagram."""
    return int.from_bytes(datagram[1 : 1 + INDEX_BYTES], "little")
