"""Build an emulated internet from namespaces: sites behind routers, a public host, and a wide area network.

    with Internet([Site("a", Kind.PORT), Site("b", Kind.SYM, hosts=2)]) as net:
        process = net.start("a1", ["ping", net.address("pub")])
        net.impair("b", loss=30)

Hosts are named after their site: ``a1``, ``b1``, ``b2``; ``pub`` is the public host, ``a-gw`` the router of ``a``.  No
address (198.18.0.0/15, RFC 2544) is routed out of the namespaces. The end of the block ends every process that was
started in the namespaces.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from sim.namespaces.impairment import Impairments
from sim.namespaces.namespace import Namespace, make_environment
from sim.namespaces.nat import LAN, WAN, NatKind, PortForward

ROOT = Path(__file__).resolve().parents[2]
PUBLIC_HOST = "pub"
PUBLIC_ADDRESSES = ("198.18.0.10", "198.18.0.11")
"""The two addresses of the public host."""
MAX_SITES = 200
Direction = Literal["in", "out", "both"]


@dataclass(frozen=True)
class Site:
    """A site with ``hosts`` computers behind a router of one kind."""

    name: str
    kind: NatKind
    hosts: int = 1


class Internet:
    """The sites within a ``with`` block; ``seed`` determines the losses. Raises ``NamespacesUnavailable``."""

    def __init__(self, sites: Sequence[Site], seed: int = 1) -> None:
        if len(sites) > MAX_SITES or len({site.name for site in sites}) < len(sites):
            raise ValueError(f"an internet must have at most {MAX_SITES} sites, with different names")
        self.sites = {site.name: site for site in sites}
        self._numbers = {site.name: number for number, site in enumerate(sites, start=1)}
        self._seed = seed
        self._namespaces: dict[str, Namespace] = {}
        self._ports: dict[str, str] = {}
        self._addresses: dict[str, str] = {}
        self._external: dict[str, str] = {}
        self._site_of_host: dict[str, str] = {}
        self._processes: list[subprocess.Popen[Any]] = []
        self._switch: subprocess.Popen[str] | None = None
        self._forwards: dict[str, list[PortForward]] = {}
        self._move_count = self._cables = 0

    def __enter__(self) -> Internet:
        try:
            self._build()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all started processes and every namespace; may be called repeatedly."""
        for process in self._processes:
            if process.poll() is None:
                process.kill()
        for process in self._processes:
            process.wait()
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()
        self._processes.clear()
        # The namespace of the wide area is closed last, because it owns the user namespace of all others.
        for name in sorted(self._namespaces, key=lambda name: name == ""):
            self._namespaces.pop(name).close()

    # -- hosts ------------------------------------------------------------------------------------------------------

    @property
    def hosts(self) -> list[str]:
        """All hosts, including the public host, but not the routers."""
        return list(self._addresses)

    def address(self, host: str) -> str:
        """Return the address of a host in its own network."""
        return self._addresses[host]

    def get_external_address(self, site: str) -> str:
        """Return the external address of a site's router."""
        return self._external[site]

    def get_namespace(self, name: str) -> Namespace:
        """Return the namespace of a host, of a router (``a-gw``), or of the wide area (the empty name)."""
        return self._namespaces[name]

    def command(self, host: str, arguments: Sequence[str]) -> list[str]:
        """Return the command that runs ``arguments`` on ``host``."""
        return self._namespaces[host].command(arguments)

    def start(self, host: str, arguments: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a program on ``host``, with options of ``Popen``; ``close`` kills the program if it still runs."""
        options = {"stdin": subprocess.DEVNULL, "cwd": ROOT, "env": make_environment(), **options}
        process = subprocess.Popen(self.command(host, arguments), **options)
        self._processes.append(process)
        return process

    def run(self, host: str, arguments: Sequence[str], timeout: float = 60.0) -> subprocess.CompletedProcess[str]:
        """Run a program on ``host`` and wait for its end."""
        return subprocess.run(
            self.command(host, arguments),
            cwd=ROOT,
            env=make_environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout,
        )

    # -- links ------------------------------------------------------------------------------------------------------

    def impair(self, site: str, way: Direction = "both", to: str = "", **figures: float) -> None:
        """Impair the link of a site (or of ``pub``) according to ``figures`` (see ``Impairments``).

        ``way`` is the direction as seen from the site. With ``to``, only the direction from ``site`` to ``to`` is
        impaired.
        """
        impairments = asdict(Impairments(**figures))
        for port in self._ports_of(site):
            if to:
                for other in self._ports_of(to):
                    self._send_order(do="weather", port=port, to=other, weather=impairments)
                continue
            for is_up in (True, False):
                if way == "both" or is_up == (way == "out"):
                    self._send_order(do="weather", port=port, to="", is_up=is_up, weather=impairments)

    def cut(self, site: str, way: Direction = "both", to: str = "") -> None:
        """Block traffic into a site, out of the site, or both; with ``to`` only from ``site`` to ``to``."""
        self.impair(site, way, to, loss=100.0)

    def heal(self, site: str) -> None:
        """Remove all impairments of a site's link."""
        self.impair(site)

    def read_counts(self) -> dict[str, Any]:
        """Return the total frames passed, frames lost and bytes passed, by link name and by ``up`` and ``down``."""
        counts: dict[str, Any] = self._send_order(do="count")
        return counts

    def record_frames(self, file: Path | None) -> None:
        """Write every frame that enters the wide area to ``file`` (in the format of ``tcpdump -w``); None stops it."""
        self._send_order(do="record", file="" if file is None else str(file.absolute()))

    # -- routers ----------------------------------------------------------------------------------------------------

    def reset_mappings(self, site: str) -> None:
        """Drop all mappings of a router, as a restart of the router does."""
        self._get_router(site).run(
            f"conntrack -F 2>/dev/null || true\nnft -f - <<'END'\nflush ruleset\n{self._make_rules(site)}END\n"
        )

    def renumber(self, site: str) -> str:
        """Change the external address of a router, as internet providers do; return the new address."""
        number = self._numbers[site]
        self._move_count += 1
        new, old = f"198.18.{1 + self._move_count % 9}.{number}", self._external[site]
        if new == old:
            return self.renumber(site)
        self._get_router(site).run(
            f"ip address add {new}/16 dev {WAN}\nip address del {old}/16 dev {WAN}\n"
            f"ip address show dev {WAN} | grep -q {new}/16 || ip address add {new}/16 dev {WAN}\n"
        )
        self._external[site] = new
        self.reset_mappings(site)
        return new

    def set_mapping_timeout(self, site: str, seconds: int) -> None:
        """Set the timeout of a router's idle mappings."""
        folder = "/proc/sys/net/netfilter/nf_conntrack_udp_timeout"
        self._get_router(site).run(f"echo {seconds} >{folder}\necho {seconds} >{folder}_stream\n")

    def move(self, host: str, site: str) -> str:
        """Move a host to another site, like a phone that leaves Wi-Fi; return its address in the new site."""
        if NatKind.NONE in (self.sites[site].kind, self.sites[self._site_of_host[host]].kind):
            raise ValueError(f"{host} can only move between sites with a router")
        self._namespaces[host].run(f"ip link del {WAN}\n")
        self._move_count += 1
        self._attach_host(host, site, 100 + self._move_count)
        return self._addresses[host]

    def forward_ports(self, site: str, host: str, *ports: tuple[Literal["udp", "tcp"], int]) -> None:
        """Forward ports of a site's router to a host."""
        opened = self._forwards.setdefault(site, [])
        opened += [PortForward(protocol, port, self._addresses[host]) for protocol, port in ports]
        self.reset_mappings(site)

    def add_isolated_host(self, name: str) -> None:
        """Create a host without a network connection."""
        self._make_namespace(name)

    def connect_cable(self, host: str, other: str) -> tuple[str, str]:
        """Connect two hosts by a separate link, like a robot and its computer; return their addresses on this link."""
        self._cables += 1
        name, first = f"cable{self._cables}", 4 * self._cables
        ends = [
            (self._namespaces[end], f"198.19.255.{first + place}") for place, end in enumerate((host, other), start=1)
        ]
        pids = [room.pid for room, _ in ends]
        self._namespaces[""].run(f"ip link add {name} netns {pids[0]} type veth peer name {name} netns {pids[1]}\n")
        for room, address in ends:
            room.run(f"ip address add {address}/30 dev {name}\nip link set {name} up\n")
        return ends[0][1], ends[1][1]

    def _get_router(self, site: str) -> Namespace:
        if self.sites[site].kind is NatKind.NONE:
            raise ValueError(f"the site {site} has no router")
        return self._namespaces[f"{site}-gw"]

    # -- construction -----------------------------------------------------------------------------------------------

    def _build(self) -> None:
        self._namespaces[""] = Namespace()
        self._disable_ipv6(self._namespaces[""])
        self._make_namespace(PUBLIC_HOST)
        self._connect_wan(PUBLIC_HOST, PUBLIC_ADDRESSES)
        self._addresses[PUBLIC_HOST] = self._external[PUBLIC_HOST] = PUBLIC_ADDRESSES[0]
        for name, site in self.sites.items():
            if site.kind is not NatKind.NONE:
                self._make_router(name)
            for number in range(1, site.hosts + 1):
                self._make_namespace(f"{name}{number}")
                self._attach_host(f"{name}{number}", name, number)
        ports = [f"{name}={interface}" for name, interface in self._ports.items()]
        pipe = subprocess.PIPE
        arguments = [sys.executable, "-m", "sim.namespaces.switch", str(self._seed), *ports]
        self._switch = self.start("", arguments, stdin=pipe, stdout=pipe, text=True)
        assert self._switch.stdout is not None
        if not self._switch.stdout.readline():
            raise RuntimeError("the switch of the wide area did not start")

    def _make_namespace(self, name: str) -> Namespace:
        namespace = self._namespaces[name] = Namespace(self._namespaces[""])
        self._disable_ipv6(namespace)
        return namespace

    def _disable_ipv6(self, namespace: Namespace) -> None:
        # With IPv6, the hosts would send unsolicited datagrams.
        namespace.run("for f in /proc/sys/net/ipv6/conf/*/disable_ipv6; do echo 1 >$f; done\nip link set lo up\n")

    def _connect_wan(self, name: str, addresses: Sequence[str]) -> None:
        """Connect a router or host to the wide area."""
        interface = f"way{len(self._ports)}"
        self._ports[name] = interface
        wide, room = self._namespaces[""], self._namespaces[name]
        wide.run(f"ip link add {interface} type veth peer name {WAN} netns {room.pid}\nip link set {interface} up\n")
        # The switch copies raw frames, so the sender must compute their checksums and limit their size (no offloading).
        given = "".join(f"ip address add {address}/16 dev {WAN}\n" for address in addresses)
        room.run(
            f"ethtool -K {WAN} tx off tso off gso off gro off >/dev/null 2>&1 || true\nip link set {WAN} up\n{given}"
        )

    def _make_router(self, site: str) -> None:
        room, number = self._make_namespace(f"{site}-gw"), self._numbers[site]
        self._external[site] = f"198.18.1.{number}"
        self._connect_wan(f"{site}-gw", (self._external[site],))
        room.run(
            f"echo 1 >/proc/sys/net/ipv4/ip_forward\n"
            f"ip link add {LAN} type bridge stp_state 0 forward_delay 0\nip link set {LAN} up\n"
            f"ip address add 198.19.{number}.1/24 dev {LAN}\nnft -f - <<'END'\n{self._make_rules(site)}END\n"
        )

    def _make_rules(self, site: str) -> str:
        return self.sites[site].kind.make_rules(self._forwards.get(site, ()))

    def _attach_host(self, host: str, site: str, place: int) -> None:
        number, room = self._numbers[site], self._namespaces[host]
        self._site_of_host[host] = site
        if self.sites[site].kind is NatKind.NONE:
            self._addresses[host] = f"198.18.{20 + number}.{place}"
            self._connect_wan(host, (self._addresses[host],))
            return
        self._addresses[host] = f"198.19.{number}.{place + 1}"
        port = f"h{place}"
        router = self._namespaces[f"{site}-gw"]
        self._namespaces[""].run(f"ip link add {WAN} netns {room.pid} type veth peer name {port} netns {router.pid}\n")
        router.run(f"ip link set {port} master {LAN} up\n")
        room.run(
            f"ip address add {self._addresses[host]}/24 dev {WAN}\nip link set {WAN} up\n"
            f"ip route add default via 198.19.{number}.1\n"
        )

    def _ports_of(self, site: str) -> list[str]:
        if site in self._ports:
            return [site]
        if self.sites[site].kind is NatKind.NONE:
            return [host for host, place in self._site_of_host.items() if place == site]
        return [f"{site}-gw"]

    def _send_order(self, **order: Any) -> Any:
        assert self._switch is not None and self._switch.stdin is not None and self._switch.stdout is not None
        self._switch.stdin.write(json.dumps(order) + "\n")
        self._switch.stdin.flush()
        answer = self._switch.stdout.readline()
        if not answer:
            raise RuntimeError("the switch of the wide area has ended")
        return json.loads(answer)
