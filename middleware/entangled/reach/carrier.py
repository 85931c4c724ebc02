"""Send datagrams through relays to nodes that this one cannot reach directly.

CARRY asks a relay to forward a datagram (``relay`` is the other side), and CARRIED delivers a forwarded datagram.
"""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.network.network import Address, is_relayed, relayed
from middleware.entangled.reach.known import MAX_KNOWN
from middleware.entangled.reach.path import PathNetwork
from middleware.entangled.reach.relay import CARRY, HEAD
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.session import Session

MAX_CARRIERS = 3
"""The number of relays remembered for the same node."""


class Carriers:
    """The relays to each node, by its id, and the datagrams through them."""

    def __init__(self, own_id: bytes, endpoint: Endpoint, paths: PathNetwork, clock: IReactorTime) -> None:
        self._own_id = own_id
        self._endpoint = endpoint
        self._paths = paths
        self._clock = clock
        self._carriers: dict[bytes, dict[bytes, float]] = {}

    def __len__(self) -> int:
        return len(self._carriers)

    def note(self, to: bytes, carrier: bytes) -> None:
        """Record that a peer relays to the node with that id."""
        carriers = self._carriers.pop(to, None) or {}
        carriers[carrier] = self._clock.seconds()
        if len(carriers) > MAX_CARRIERS:
            del carriers[min(carriers, key=lambda public: carriers[public])]
        keep(self._carriers, to, carriers, MAX_KNOWN)

    def of(self, to: bytes) -> list[bytes]:
        """Return the public keys of the relays to the node with that id."""
        return list(self._carriers.get(to, ()))

    def contacts(self, to: bytes) -> list[Contact]:
        """Return the relays to that node that this node reaches directly."""
        sessions = [self._endpoint.peers.direct_session(public) for public in self.of(to)]
        return [session.contact for session in sessions if session is not None]

    def session(self, to: bytes) -> Session | None:
        """Return the direct session with the latest known relay to the node with that id."""
        carriers = self._carriers.get(to, {})
        for public in sorted(carriers, key=lambda public: -carriers[public]):
            session = self._endpoint.peers.direct_session(public)
            if session is not None:
                return session
        return None

    def carry(self, datagram: bytes, to: Address) -> None:
        """Send a datagram through a relay to the node with that virtual address; it is lost if there is no relay."""
        target = _id_in(to)
        carrier = self.session(target) if target else None
        if carrier is None:
            self._endpoint.counters["uncarried"] += 1
        else:
            self._endpoint.send_inside(carrier, bytes([CARRY]) + target + datagram)

    def on_carried(self, session: Session, plain: bytes, source: Address) -> None:
        """Process a datagram that the peer of ``session`` relayed to this node."""
        inner, sender = plain[HEAD:], plain[1:HEAD]
        if not inner or is_relayed(session.contact.address) or sender == self._own_id:
            self._endpoint.counters["malformed"] += 1
            return
        self.note(sender, session.contact.public)
        self._paths.carried(inner, relayed(sender))


def _id_in(address: Address) -> bytes:
    try:
        found = bytes.fromhex(address.host[1:])
    except ValueError:
        return b""
    return found if len(found) == ID_BYTES else b""
