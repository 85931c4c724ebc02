"""Kind: what a site's router does with UDP, as rules for ``nft``.

The words are those of RFC 4787: a *mapping* is the outside port that an inside socket gets, a *filter* says whose
datagrams come in through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal

WAN, LAN = "eth0", "lan"
REMEMBERED_S = 300
"""Seconds for which ``full`` and ``addr`` remember a port that nobody uses."""


@dataclass(frozen=True)
class Forward:
    """A port of a router at which a host behind it is found."""

    protocol: Literal["udp", "tcp"]
    port: int
    host: str


class Kind(Enum):
    """Kinds of routers, from the most open to the most closed."""

    NONE = "none"
    """No router: the hosts have outside addresses."""
    FULL = "full"
    """One mapping for all peers, no filter ("full cone")."""
    ADDR = "addr"
    """One mapping; in comes who sends from an address that was written to ("restricted cone")."""
    PORT = "port"
    """One mapping; in comes who sends from an address and port that was written to ("port restricted")."""
    LEAKY = "leaky"
    """As ``port``, but what nobody asked for reaches the router itself and stays in its memory: a peer that knocks
    before the inside socket does takes the mapping away.  A Linux box that masquerades and has no firewall."""
    SYM = "sym"
    """Another mapping, at a random port, for each peer ("symmetric")."""
    NOUDP = "noudp"
    """Lets no UDP through; TCP as ``port``."""

    @property
    def meaning(self) -> str:
        """What it is, for people."""
        return _MEANINGS[self]

    def rules(self, forwards: Sequence[Forward] = ()) -> str:
        """The whole rule set of such a router, which hands what ``forwards`` name to hosts behind it."""
        outward = f'oifname "{WAN}" masquerade' + (" fully-random" if self is Kind.SYM else "")
        memory = inward = through = ""
        shield = "" if self is Kind.LEAKY else f'iifname "{WAN}" ct state new drop'
        if self is Kind.NOUDP:
            through = "meta l4proto udp drop"
        elif self in (Kind.FULL, Kind.ADDR):
            # The kernel's own translation filters by address and port; so the port's owner is noted down beside it.
            timed = f"flags dynamic,timeout; timeout {REMEMBERED_S}s; size 65535;"
            memory = f"map owner {{ type inet_service : ipv4_addr; {timed} }}\n"
            memory += f"set written {{ type ipv4_addr . inet_service; {timed} }}"
            through = f'oifname "{WAN}" meta l4proto udp update @owner {{ udp sport : ip saddr }}'
            through += " update @written { ip daddr . udp sport }"
            known = "ip saddr . udp dport @written " if self is Kind.ADDR else ""
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


_MEANINGS = {
    Kind.NONE: "no router",
    Kind.FULL: "full cone",
    Kind.ADDR: "address restricted",
    Kind.PORT: "port restricted",
    Kind.LEAKY: "port restricted, no firewall",
    Kind.SYM: "symmetric",
    Kind.NOUDP: "UDP blocked",
}
