"""Measurements for ``swarm doctor``, taken from this machine with separate sockets.

A node replies to a PROBE from any sender, and to a DISCOVERY from a member of its team.  All measurements together
take about two seconds.
"""

from __future__ import annotations

import errno
import hashlib
import os
import random
import select
import shutil
import socket
import stat
import struct
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from ipaddress import ip_address
from pathlib import Path

from middleware.config.settings import IN_MEMORY, Settings
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.network.interface import Interface, is_any, list_interfaces, select_interfaces
from middleware.entangled.network.multicast import GROUP
from middleware.entangled.network.network import Address
from middleware.entangled.wire.discovery import open_discovery, pack_discovery
from middleware.entangled.wire.probe import PROBE_REPLY, pack_probe, parse_reply
from middleware.entangled.wire.session import derive_key
from swarmnode.doctor.facts import Answer, Certificate, Facts, Health, LanDiscovery, Probe, Storage, is_local
from swarmnode.ports import is_free

PROBE_COUNT = 4
PROBE_INTERVAL_S = 0.3
TCP_TIMEOUT_S = 1.0
TUNNEL_PORT = 443
MAX_PROBED = 32
_IP_RECVERR, _IP_PKTINFO, _IP_MULTICAST_ALL = 11, 8, 49


@dataclass
class Team:
    """The team of the node: secrets for DISCOVERY, fingerprint, certificate, and bootstrap nodes."""

    secrets: Sequence[bytes]
    fingerprint: bytes = bytes(8)
    certificate: Certificate | None = None
    known: Sequence[Address] = ()


@dataclass
class _Replies:
    lan_tokens: set[bytes] = field(default_factory=set)
    lan_answers: dict[Address, Answer] = field(default_factory=dict)
    answers: dict[Address, Answer] = field(default_factory=dict)
    members: set[Address] = field(default_factory=set)
    errors: dict[Address, str] = field(default_factory=dict)
    is_sent: bool = False
    has_received_own: bool = False


def measure_facts(
    settings: Settings,
    is_running: bool = False,
    health: Health | None = None,
    wall: Callable[[], float] = time.time,
) -> Facts:
    """Measure the facts of the node with these settings; host names must be resolved already."""
    node = settings.node
    team = load_team(settings)
    found = tuple(list_interfaces())
    named = dict.fromkeys([*node.known_nodes, *team.known])
    known = [each for each in named if _is_numeric(each) and not _is_self(each, node.host, node.port, found)]
    known = known[:MAX_PROBED]
    port_problem = ""
    if node.port and not is_free(socket.SOCK_DGRAM, "" if is_any(node.host) else node.host, node.port):
        port_problem = f"Another program uses {node.host}:{node.port}."
    lan_interfaces = select_interfaces(list(found), node.host) if node.lan and not is_local(node.host) else []
    replies = _probe_all(node.host, known, team.secrets, lan_interfaces, wall)
    gateway = _find_router()
    return Facts(
        node.name,
        node.host,
        node.port,
        wall(),
        interfaces=found,
        known=tuple(_make_probe(address, replies, found) for address in known),
        lan=LanDiscovery(tuple(replies.lan_answers.values()), replies.is_sent, replies.has_received_own)
        if lan_interfaces
        else None,
        port_problem=port_problem if settings.is_given("node", "port") else "",
        is_running=is_running,
        fingerprint=team.fingerprint,
        source_address=_find_source_address([each.host for each in known if not is_local(each.host)]),
        is_gateway_resolved=_is_resolved(gateway) if gateway else None,
        certificate=team.certificate,
        storage=_check_storage(node.store),
        open_files=tuple(_find_readable_files(_list_secret_files(settings))),
        health=health,
    )


def load_team(settings: Settings) -> Team:
    """Return the team to which the settings belong."""
    path = settings.node.membership
    if not path:
        return Team([settings.node.team_secret])
    # Imported on demand: only needed for closed teams.
    from middleware.admission.membership_file import MembershipFile

    try:
        kept = MembershipFile(Path(path)).membership
        member = kept.member
    except Exception as error:  # an error in the file is reported as a finding
        return Team([], certificate=Certificate(problem=str(error)))
    mark = hashlib.blake2s(kept.operator, digest_size=8, person=b"team").digest()
    secrets = [secret for _, secret, _ in kept.secrets]
    return Team(secrets, mark, Certificate(member.not_before, member.not_after), kept.known_nodes)


def discover_on_lan() -> list[Answer]:
    """Return the replies of nodes of any team to a PROBE on the LAN, after ``PROBE_COUNT`` x ``PROBE_INTERVAL_S``.

    In this way a newcomer, which has no team yet, finds bootstrap nodes.  In a large team only some nodes reply to each
    call.
    """
    return list(_probe_all("*", [], [], select_interfaces(list_interfaces(), "*"), time.time).lan_answers.values())


# -- network ----------------------------------------------------------------------------------------------------------


def _probe_all(
    host: str,
    known: Sequence[Address],
    secrets: Sequence[bytes],
    lan_interfaces: Sequence[Interface],
    wall: Callable[[], float],
) -> _Replies:
    """Probe all known nodes from one socket, so their replies are comparable; probe the LAN on ``lan_interfaces``."""
    replies = _Replies()
    rng = random.SystemRandom()
    keys = [derive_key(secret, b"greet") for secret in secrets]
    tokens = {rng.randbytes(16): address for address in known}
    sockets = _open_sockets(host, known)
    multicast = _open_multicast_socket(lan_interfaces) if lan_interfaces else None
    try:
        for _ in range(PROBE_COUNT):
            for token, address in tokens.items():
                _send(sockets, pack_probe(token), address, replies)
                if address not in replies.members:
                    for key in keys:
                        _send(sockets, pack_discovery(key, token, rng), address, replies)
            if lan_interfaces:
                call = rng.randbytes(16)
                replies.lan_tokens.add(call)
                _send_multicast(sockets, pack_probe(call), lan_interfaces, replies)
            _receive_replies(
                [*sockets.values(), *([] if multicast is None else [multicast])], multicast, keys, replies, wall
            )
            if known and not lan_interfaces and replies.members >= set(known) and replies.answers.keys() >= set(known):
                break
    finally:
        for each in [*sockets.values(), multicast]:
            if each is not None:
                each.close()
    return replies


def _open_sockets(host: str, known: Iterable[Address]) -> dict[int, socket.socket]:
    """Open one socket per required address family, at the node's address and any port."""
    by_family: dict[int, socket.socket] = {}
    families = {socket.AF_INET6 if ":" in address.host else socket.AF_INET for address in known} | {socket.AF_INET}
    for family in families:
        try:
            opened = socket.socket(family, socket.SOCK_DGRAM)
            opened.setblocking(False)
            if family == socket.AF_INET:
                opened.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
                opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
            own = "" if is_any(host) or (":" in host) != (family == socket.AF_INET6) else host
            try:
                opened.bind((own, 0))
            except OSError:
                opened.bind(("", 0))  # a separate check reports an address that does not belong to this machine
        except OSError:
            continue
        by_family[family] = opened
    return by_family


def _open_multicast_socket(lan_interfaces: Sequence[Interface]) -> socket.socket | None:
    """Open a socket in the multicast group of the LAN, as a node does."""
    multicast = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        multicast.setblocking(False)
        multicast.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        multicast.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        multicast.bind(GROUP)
        for interface in lan_interfaces:
            with suppress(OSError):
                request = struct.pack("4s4si", socket.inet_aton(GROUP.host), bytes(4), interface.index)
                multicast.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)
    except OSError:
        multicast.close()
        return None
    return multicast


def _send(sockets: dict[int, socket.socket], datagram: bytes, to: Address, replies: _Replies) -> None:
    by = sockets.get(socket.AF_INET6 if ":" in to.host else socket.AF_INET)
    if by is None:
        replies.errors[to] = "unreachable"
        return
    for _ in range(2):  # raised for an earlier datagram that could not be delivered
        try:
            by.sendto(datagram, to)
            return
        except OSError as error:
            if error.errno in (errno.ENETUNREACH, errno.EPERM, errno.EACCES, errno.EINVAL):
                replies.errors[to] = "unreachable"


def _send_multicast(
    sockets: dict[int, socket.socket], datagram: bytes, lan_interfaces: Sequence[Interface], replies: _Replies
) -> None:
    by = sockets.get(socket.AF_INET)
    if by is None:
        return
    for interface in lan_interfaces:
        for address in [each for each in interface.addresses if ":" not in each]:
            packet_info = struct.pack("i4s4s", interface.index, socket.inet_aton(address), bytes(4))
            with suppress(OSError):
                by.sendmsg([datagram], [(socket.IPPROTO_IP, _IP_PKTINFO, packet_info)], 0, GROUP)
                replies.is_sent = True


def _receive_replies(
    sockets: Sequence[socket.socket],
    multicast: socket.socket | None,
    keys: Sequence[bytes],
    replies: _Replies,
    wall: Callable[[], float],
) -> None:
    until = time.monotonic() + PROBE_INTERVAL_S
    ours = {each.getsockname()[1] for each in sockets if each is not multicast}
    while (left := until - time.monotonic()) > 0:
        for ready in select.select(sockets, [], [], left)[0]:
            _read_errors(ready, replies)
            try:
                datagram, source = ready.recvfrom(2048)
            except OSError:
                continue
            if ready is multicast:
                replies.has_received_own = replies.has_received_own or source[1] in ours
            elif datagram[:1] == bytes([PROBE_REPLY]):
                _on_probe_reply(datagram, Address(source[0], source[1]), replies, wall())
            else:
                _on_discovery_reply(datagram, Address(source[0], source[1]), keys, replies)


def _on_probe_reply(datagram: bytes, source: Address, replies: _Replies, now: float) -> None:
    try:
        echo = parse_reply(datagram)
    except Malformed:
        return
    offset = echo.unix_time_s - now if echo.unix_time_s else None
    answers = replies.lan_answers if echo.token in replies.lan_tokens else replies.answers
    answers.setdefault(source, Answer(source, echo.version, echo.fingerprint, offset, echo.observed_address))


def _on_discovery_reply(datagram: bytes, source: Address, keys: Sequence[bytes], replies: _Replies) -> None:
    for key in keys:
        with suppress(Forged):
            open_discovery(key, datagram)
            replies.members.add(source)
            return


def _read_errors(ready: socket.socket, replies: _Replies) -> None:
    """Read the ICMP errors for datagrams that could not be delivered."""
    while ready.family == socket.AF_INET:
        try:
            _, messages, _, to = ready.recvmsg(2048, 512, socket.MSG_ERRQUEUE)
        except OSError:
            return
        for level, kind, data in messages:
            if level == socket.IPPROTO_IP and kind == _IP_RECVERR and len(data) >= 4:
                number = struct.unpack_from("I", data)[0]
                refused = number == errno.ECONNREFUSED
                replies.errors[Address(to[0], to[1])] = "refused" if refused else "unreachable"


def _make_probe(address: Address, replies: _Replies, found: Sequence[Interface]) -> Probe:
    probe = Probe(
        address,
        replies.answers.get(address),
        address in replies.members,
        replies.errors.get(address, ""),
        _is_near(address.host, found),
    )
    if probe.has_reply:
        return replace(probe, error="")
    if probe.is_near:
        resolved = _is_resolved(address.host)
        return replace(probe, is_resolved=resolved, error="" if probe.error == "unreachable" else probe.error)
    return probe if probe.error else replace(probe, is_tcp=_answers_tcp(address))


def _answers_tcp(address: Address) -> bool:
    """Return whether the machine replies to TCP, even if only with a refusal."""
    for port in (address.port, TUNNEL_PORT):
        try:
            socket.create_connection((address.host, port), TCP_TIMEOUT_S).close()
            return True
        except ConnectionRefusedError:
            return True
        except OSError:
            continue
    return False


# -- the machine ------------------------------------------------------------------------------------------------------


def _is_numeric(address: Address) -> bool:
    """Return whether the address is numeric; tunnels and relays have virtual addresses."""
    try:
        return ip_address(address.host.partition("%")[0]).version > 0
    except ValueError:
        return False


def _is_self(address: Address, host: str, port: int, found: Sequence[Interface]) -> bool:
    mine = {own for interface in found for own in interface.addresses} if is_any(host) else {host}
    return bool(port) and address.port == port and address.host in mine


def _find_source_address(hosts: Sequence[str]) -> str:
    """Return the source address for datagrams to the first host."""
    for host in hosts[:1]:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((host, 9))  # sends nothing
            return str(probe.getsockname()[0])
    return ""


def _is_near(host: str, found: Sequence[Interface]) -> bool:
    """Return whether ``host`` is in a subnet of this machine (IPv4: by the routing table, IPv6: same /64)."""
    address = ip_address(host.partition("%")[0])
    if address.version == 6:
        mine = [ip_address(each) for i in found for each in i.addresses if ":" in each and not i.is_loopback]
        return any(int(address) >> 64 == int(own) >> 64 for own in mine)
    routes = [(network, mask) for network, gateway, mask in _read_routes() if not gateway and mask]
    return any(int(address) & mask == network for network, mask in routes)


def _find_router() -> str:
    """Return the default router, or an empty string."""
    for network, gateway, mask in _read_routes():
        if gateway and not network and not mask:
            return str(ip_address(gateway))
    return ""


def _read_routes() -> list[tuple[int, int, int]]:
    """Return (network, gateway, mask) of each IPv4 route."""
    try:
        lines = Path("/proc/net/route").read_text(encoding="ascii").splitlines()[1:]
    except (OSError, ValueError):
        return []
    rows = [line.split() for line in lines]
    return [(_parse_address(row[1]), _parse_address(row[2]), _parse_address(row[7])) for row in rows if len(row) > 7]


def _parse_address(digits: str) -> int:
    """Convert an address as the kernel prints it: four bytes in native byte order."""
    return int.from_bytes(int(digits, 16).to_bytes(4, sys.byteorder))


def _is_resolved(host: str) -> bool | None:
    """Return whether the hardware address of a neighbour was resolved; None if that is unknown."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.sendto(b"", (host, 9))  # triggers the resolution
        time.sleep(0.05)
    try:
        lines = Path("/proc/net/arp").read_text(encoding="ascii").splitlines()[1:]
    except (OSError, ValueError):
        return None
    rows = [line.split() for line in lines]
    flags = [int(row[2], 16) for row in rows if len(row) > 2 and row[0] == host]
    return bool(flags[0] & 0x2) if flags else False


def _check_storage(path: str) -> Storage | None:
    if path == IN_MEMORY:
        return None
    file = Path(path)
    folder = file.parent
    problem = ""
    if file.is_dir():
        problem = "It is a folder."
    elif file.exists():
        problem = "" if os.access(file, os.R_OK | os.W_OK) else "This user has no permission to write it."
    elif not folder.is_dir():
        problem = f"The folder {folder} does not exist."
    if not problem and not os.access(folder, os.W_OK | os.X_OK):
        problem = f"This user has no permission to write in {folder}."
    try:
        free = shutil.disk_usage(folder).free
        probe = os.statvfs(folder)
        if not problem and probe.f_flag & os.ST_RDONLY:
            problem = "Its disk is read-only."
    except OSError:
        free = None
    if not problem and free == 0:
        problem = "Its disk is full."
    return Storage(path, problem, free)


def _list_secret_files(settings: Settings) -> list[str]:
    paths = [settings.node.membership, settings.node.store]
    if settings.is_given("node", "team_key"):
        paths.append(settings.origin)
    return [path for path in paths if path and path != IN_MEMORY]


def _find_readable_files(paths: Iterable[str]) -> Iterable[tuple[str, int]]:
    for path in paths:
        with suppress(OSError):
            mode = stat.S_IMODE(os.stat(path).st_mode)
            if mode & 0o077:
                yield path, mode
