"""Learn the external address of each local port from peers.

A peer replies to ADDRESS_REQUEST ``0x06 | token 8 | zero 18`` with ADDRESS_REPLY ``0x07 | token 8 | address 16, port
2``, which it sends to the source address of the request.  Both messages are sent in a session.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.network.network import ADDRESS_BYTES, Address, LocalPorts, pack_address, parse_address
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.session import Session

ADDRESS_REQUEST = 0x06
ADDRESS_REPLY = 0x07
_TOKEN_BYTES = 8
_MESSAGE_BYTES = 1 + _TOKEN_BYTES + ADDRESS_BYTES
TRIES, INTERVAL_S = 5, 0.1
MAX_PENDING = 64
REPLIES_PER_S, REPLY_BURST = 50.0, 100.0


class AddressQuery:
    """Asks peers for this node's external address, and answers such requests.

    ``send`` encrypts a message and sends it to an address; ``rng`` is called on first use and returns the random
    generator.
    """

    def __init__(
        self,
        send: Callable[[Session, bytes, Address], None],
        ports: LocalPorts,
        clock: IReactorTime,
        rng: Callable[[], random.Random],
        background: Background,
    ) -> None:
        self._send = send
        self._ports = ports
        self._clock = clock
        self._rng = rng
        self._background = background
        self._bucket = TokenBucket(REPLIES_PER_S, REPLY_BURST)
        self._pending: dict[bytes, Callable[[Address | None], None]] = {}

    def ask(self, session: Session, port: int = 0) -> Deferred[Address | None]:
        """Return the address at which the peer of ``session`` sees this node's ``port``; None without a reply."""
        seen: Deferred[Address | None] = Deferred()
        token = self._rng().randbytes(_TOKEN_BYTES)
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
            before = self._ports.assign_port(to, port) if port else 0
            self._send(session, bytes([ADDRESS_REQUEST]) + token + bytes(ADDRESS_BYTES), to)
            if port:
                self._ports.assign_port(to, before)
            self._background.later(INTERVAL_S, again, left - 1)

        if len(self._pending) >= MAX_PENDING:
            seen.callback(None)
            return seen
        self._pending[token] = done
        again(TRIES)
        return seen

    def on_request(self, session: Session, plain: bytes, source: Address) -> None:
        """Send a peer its source address."""
        if len(plain) != _MESSAGE_BYTES or not self._bucket.take(self._clock.seconds()):
            return
        self._send(session, bytes([ADDRESS_REPLY]) + plain[1 : 1 + _TOKEN_BYTES] + pack_address(source), source)

    def on_reply(self, session: Session, plain: bytes, source: Address) -> None:
        """Process the reply to an ADDRESS_REQUEST."""
        done = self._pending.get(plain[1 : 1 + _TOKEN_BYTES])
        if len(plain) == _MESSAGE_BYTES and done is not None:
            done(parse_address(plain[1 + _TOKEN_BYTES :]))
