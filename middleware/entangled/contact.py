"""Contact: a node as others know it."""

from __future__ import annotations

from dataclasses import dataclass, field

from middleware.entangled.identity import node_id
from middleware.entangled.network.network import Address, relayed


@dataclass(frozen=True, slots=True)
class Contact:
    """A node's public key (32 bytes) and address; the id follows from the key."""

    public: bytes
    address: Address
    node_id: bytes = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "node_id", node_id(self.public))

    def packed(self) -> list[object]:
        """The contact as it stands in a message: a way that is this node's own (a tunnel) is of no use to others."""
        host, port = relayed(self.node_id) if self.address.is_virtual else self.address
        return [self.public, host, port]


def unpacked(fields: object) -> Contact | None:
    """The contact that ``packed`` made, or None where the fields cannot be one."""
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
    # Nobody can name a way of ours: whatever stands there, it only says that others have to carry what is sent.
    return Contact(public, relayed(contact.node_id)) if host[0] == "~" else contact
