"""Define kinds of NAT routers as rules for ``nft``.

Terms of RFC 4787: a *mapping* is the external port of an internal socket; *filtering* decides which external datagrams
may enter through this port.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal

WAN, LAN = "eth0", "lan"
MAPPING_TIMEOUT_S = 300
"""Seconds for which ``full`` and ``addr`` keep the mapping of an idle port."""


@dataclass(frozen=True)
class PortForward:
    """A port of a router that is forwarded to a host behind it."""

    protocol: Literal["udp", "tcp"]
    port: int
    host: str


class NatKind(Enum):
    """Kinds of routers, from the most open to the most restrictive."""

    NONE = "none"
    """No router: the hosts have external addresses."""
    FULL = "full"
    """One mapping for all peers, no filter ("full cone")."""
    ADDR = "addr"
    """One mapping for all peers; accepts datagrams only from addresses to which the host has sent ("restricted
    cone")."""
    PORT = "port"
    """One mapping for all peers; accepts datagrams only from address and port pairs to which the host has sent ("port
    restricted")."""
    LEAKY = "leaky"
    """Like ``port``, but an unsolicited datagram reaches the router and creates a connection tracking entry, so a peer
    that sends first prevents the mapping of the host. This is a Linux router with masquerading and no firewall."""
    SYM = "sym"
    """A different, random mapping for each peer ("symmetric")."""
    NOUDP = "noudp"
    """Blocks UDP; TCP as ``port``."""

    @property
    def description(self) -> str:
        """A short description of this kind for tables."""
        return _DESCRIPTIONS[self]

    def make_rules(self, forwards: Sequence[PortForward] = ()) -> str:
        """Return the rule set of a router of this kind, with the port forwardings ``forwards``."""
        outward = f'oifname "{WAN}" masquerade' + (" fully-random" if self is NatKind.SYM else "")
        memory = inward = through = ""
        shield = "" if self is NatKind.LEAKY else f'iifname "{WAN}" ct state new drop'
        if self is NatKind.NOUDP:
            through = "meta l4proto udp drop"
        elif self in (NatKind.FULL, NatKind.ADDR):
            # The kernel's NAT always filters by address and port, so a map stores the host that owns each port.
            timed = f"flags dynamic,timeout; timeout {MAPPING_TIMEOUT_S}s; size 65535;"
            memory = f"map owner {{ type inet_service : ipv4_addr; {timed} }}\n"
            memory += f"set written {{ type ipv4_addr . inet_service; {timed} }}"
            through = f'oifname "{WAN}" meta l4proto udp update @owner {{ udp sport : ip saddr }}'
            through += " update @written { ip daddr . udp sport }"
            known = "ip saddr . udp dport @written " if self is NatKind.ADDR else ""
            inward = f'iifname "{WAN}" meta l4proto udp {known}dnat to udp dport map @owner'
        opened = [f'iifname "{WAN}" {f.protocol} dport {f.port} dnat to {f.host}' for f in forwards]
        inward = "; ".join([*opened, *([inward] if inward else [])])
        return f"""table ip site {{
{memory}
chain inward {{ type nat hook prerouting priority -100; {inward}; }}
chain outward {{ type nat hook postrouting priority 100; {outward}; }}
chain shield {{ type filter hook input priority 0; {shield}; }}
chain through {{ type filter hook forward priority 0; {through}; }}
}}
""".replace("; ; }", "; }")


_DESCRIPTIONS = {
    NatKind.NONE: "no router",
    NatKind.FULL: "full cone",
    NatKind.ADDR: "address restricted",
    NatKind.PORT: "port restricted",
    NatKind.LEAKY: "port restricted, no firewall",
    NatKind.SYM: "symmetric",
    NatKind.NOUDP: "UDP blocked",
}
