"""Mirror: how a node learns the address that others see when it sends, by each of its local ports.

MIRROR ``0x06 | token 8 | zero 18`` is answered by IMAGE ``0x07 | token 8 | address 16, port 2`` to where it came from;
both travel in a session.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.network.network import ADDRESS, Address, Ports, address_of, packed_address
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.session import Session

MIRROR = 0x06
IMAGE = 0x07
_TOKEN = 8
_LENGTH = 1 + _TOKEN + ADDRESS
TRIES, GAP = 5, 0.1
MAX_PENDING = 64
RATE, BURST = 50.0, 100.0


class Mirror:
    """Asks peers for the own address, and tells them theirs; ``send`` seals for a session and sends to an address.

    ``rng`` gives dice when they are needed.
    """

    def __init__(
        self,
        send: Callable[[Session, bytes, Address], None],
        ports: Ports,
        clock: IReactorTime,
        rng: Callable[[], random.Random],
        chores: Background,
    ) -> None:
        self._send = send
        self._ports = ports
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._bucket = TokenBucket(RATE, BURST)
        self._pending: dict[bytes, Callable[[Address | None], None]] = {}

    def look(self, session: Session, port: int = 0) -> Deferred[Address | None]:
        """The address that the peer of ``session`` sees when this node sends by ``port``; None where none was told."""
        seen: Deferred[Address | None] = Deferred()
        token = self._rng().randbytes(_TOKEN)
        to = session.contact.address

        def done(address: Address | None) -> None:
            if self._pending.pop(token, None) is not None:
                seen.callback(address)

        def again(left: int) -> None:
            if token not in self._pending:
                return
            if not left:
                done(None)
                return
            before = self._ports.lead(to, port) if port else 0
            self._send(session, bytes([MIRROR]) + token + bytes(ADDRESS), to)
            if port:
                self._ports.lead(to, before)
            self._chores.later(GAP, again, left - 1)

        if len(self._pending) >= MAX_PENDING:
            seen.callback(None)
            return seen
        self._pending[token] = done
        again(TRIES)
        return seen

    def on_mirror(self, session: Session, plain: bytes, source: Address) -> None:
        """Tell a peer the address that it wrote from."""
        if len(plain) != _LENGTH or not self._bucket.take(self._clock.seconds()):
            return
        self._send(session, bytes([IMAGE]) + plain[1 : 1 + _TOKEN] + packed_address(source), source)

    def on_image(self, session: Session, plain: bytes, source: Address) -> None:
        """Take the answer."""
        done = self._pending.get(plain[1 : 1 + _TOKEN])
        if len(plain) == _LENGTH and done is not None:
            done(address_of(plain[1 + _TOKEN :]))
