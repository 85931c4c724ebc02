"""Send datagrams through relays to nodes that this node cannot reach directly.

With RELAY_REQUEST a node asks a relay to forward a datagram; the relay delivers it as RELAYED_DATAGRAM.  The module
``relay`` implements the relay.
"""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.nat.known_peers import MAX_KNOWN
from middleware.entangled.nat.relay import HEADER_BYTES, RELAY_REQUEST
from middleware.entangled.nat.relayed_network import RelayedNetwork
from middleware.entangled.network.network import Address, is_relayed, relayed_address
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.session import Session

MAX_RELAYS = 3
"""The number of relays remembered for the same node."""


class RelayClient:
    """Remembers the relays to each node, by its id, and sends and receives datagrams through them."""

    def __init__(self, own_id: bytes, endpoint: Endpoint, network: RelayedNetwork, clock: IReactorTime) -> None:
        self._own_id = own_id
        self._endpoint = endpoint
        self._network = network
        self._clock = clock
        self._relays: dict[bytes, dict[bytes, float]] = {}

    def __len__(self) -> int:
        return len(self._relays)

    def add_relay(self, to: bytes, relay: bytes) -> None:
        """Record that the peer ``relay`` relays to the node with the id ``to``."""
        relays = self._relays.pop(to, None) or {}
        relays[relay] = self._clock.seconds()
        if len(relays) > MAX_RELAYS:
            del relays[min(relays, key=lambda public: relays[public])]
        put_bounded(self._relays, to, relays, MAX_KNOWN)

    def relay_keys(self, to: bytes) -> list[bytes]:
        """Return the public keys of the relays to the node with that id."""
        return list(self._relays.get(to, ()))

    def find_contacts(self, to: bytes) -> list[Contact]:
        """Return the contacts of those relays to the node with that id that this node reaches directly."""
        sessions = [self._endpoint.peers.find_direct_session(public) for public in self.relay_keys(to)]
        return [session.contact for session in sessions if session is not None]

    def find_session(self, to: bytes) -> Session | None:
        """Return the direct session with the latest known relay to the node with that id."""
        relays = self._relays.get(to, {})
        for public in sorted(relays, key=lambda public: -relays[public]):
            session = self._endpoint.peers.find_direct_session(public)
            if session is not None:
                return session
        return None

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram through a relay to the node with that virtual address; it is lost if there is no relay."""
        target = _parse_node_id(to)
        relay = self.find_session(target) if target else None
        if relay is None:
            self._endpoint.counters["uncarried"] += 1
        else:
            self._endpoint.send_sealed(relay, bytes([RELAY_REQUEST]) + target + datagram)

    def on_relayed(self, session: Session, plain: bytes, source: Address) -> None:
        """Process a datagram that the peer of ``session`` relayed to this node."""
        inner, sender = plain[HEADER_BYTES:], plain[1:HEADER_BYTES]
        if not inner or is_relayed(session.contact.address) or sender == self._own_id:
            self._endpoint.counters["malformed"] += 1
            return
        self.add_relay(sender, session.contact.public)
        self._network.receive_relayed(inner, relayed_address(sender))


def _parse_node_id(address: Address) -> bytes:
    try:
        found = bytes.fromhex(address.host[1:])
    except ValueError:
        return b""
    return found if len(found) == ID_BYTES else b""
