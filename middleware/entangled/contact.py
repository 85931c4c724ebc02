"""Define the contact of a node."""

from __future__ import annotations

from dataclasses import dataclass, field

from middleware.entangled.identity import derive_node_id
from middleware.entangled.network.network import Address, relayed_address


@dataclass(frozen=True, slots=True)
class Contact:
    """A node's public key (32 bytes) and address; the node id is derived from the key."""

    public: bytes
    address: Address
    node_id: bytes = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "node_id", derive_node_id(self.public))

    def pack(self) -> list[object]:
        """Encode the contact for a message; replace a virtual address of this node (a tunnel) by a relayed address."""
        host, port = relayed_address(self.node_id) if self.address.is_virtual else self.address
        return [self.public, host, port]


def parse_contact(fields: object) -> Contact | None:
    """Decode a contact, or return None if the fields are invalid."""
    if not isinstance(fields, list) or len(fields) != 3:
        return None
    public, host, port = fields
    if not (isinstance(public, bytes) and len(public) == 32):
        return None
    if not (isinstance(host, str) and 0 < len(host) <= 45):
        return None
    if not (type(port) is int and 0 < port < 65536):
        return None
    contact = Contact(public, Address(host, port))
    # A virtual address from a peer is meaningless at this node; it only indicates that the contact needs a relay.
    return Contact(public, relayed_address(contact.node_id)) if host[0] == "~" else contact
