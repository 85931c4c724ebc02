"""``swarm join CODE``: make this machine a member of a closed team."""

from __future__ import annotations

import argparse
import os
import re
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred

from middleware.admission import join_code as codes
from middleware.admission import keyfile
from middleware.admission import membership_file as memberships
from middleware.admission.errors import BadCode, BadKeyFile
from middleware.admission.join_client import JOIN_TIMEOUT_S, JoinClient
from middleware.admission.join_code import JoinCode
from middleware.admission.membership_file import Membership
from middleware.admission.statement import NAME_PATTERN, check_bytes
from middleware.config.settings import COMMAND_LINE, NodeSettings, Settings
from middleware.entangled.errors import EntangledError, RemoteError
from middleware.entangled.network.interface import is_loopback
from middleware.entangled.network.network import ANY_HOST, Address, find_alternate_paths
from middleware.errors import BadSetting
from swarmnode.control_client import Rejection
from swarmnode.team.common import Answer, CommandContext, InvalidCommand, make_parser, parse_duration, run_verb
from swarmnode.team.init import SHARED_KEYS, format_settings, write_settings

SEED_FILE_KIND = "swarm-node joining 1"
SendJoinRequests = Callable[[JoinCode, bytes, str, Sequence[Address], float], Membership]
FindNodes = Callable[[], Sequence[Address]]


def main(
    words: Sequence[str] | None = None,
    context: CommandContext | None = None,
    send_requests: SendJoinRequests | None = None,
    find_nodes: FindNodes | None = None,
) -> int:
    """Run the command; returns its exit code."""
    purpose = "Join a closed team with a code of its operator."
    example = "K9TJ7-17QR2-Z31JA-KH77T@192.168.1.10:8484"
    join = make_parser("join", purpose, needs_key=False, is_asked=False, example=example)
    join.add_argument("code", metavar="CODE", help="code shown by swarm invite, with or without @HOST:PORT")
    join.add_argument(
        "--at",
        metavar="HOST:PORT",
        action="append",
        default=[],
        help="address of a bootstrap node (default: search the LAN)",
    )
    join.add_argument(
        "--tunnel", metavar="URL", action="append", default=[], help="tunnel if UDP is blocked, as wss://HOST:PORT"
    )
    join.add_argument(
        "--name", metavar="NAME", default="", help="name of this member, if the code does not determine it"
    )
    join.add_argument(
        "--folder", metavar="DIR", type=Path, default=Path("."), help="folder for this member's files (default: .)"
    )
    join.add_argument("--files", metavar="NAME", default="swarm", help="base name of these files (default: swarm)")
    join.add_argument(
        "--timeout", type=parse_duration, default=JOIN_TIMEOUT_S, metavar="TIME", help="maximum time (default: 20s)"
    )

    def work(arguments: argparse.Namespace, context: CommandContext) -> Answer:
        return _join(
            arguments, context, send_requests or _make_join_function(arguments.tunnel), find_nodes or find_lan_nodes
        )

    return run_verb(join, words, context, work)


def _join(
    arguments: argparse.Namespace, context: CommandContext, send_requests: SendJoinRequests, find_nodes: FindNodes
) -> Answer:
    text, _, behind = arguments.code.partition("@")
    try:
        code = codes.parse_code(text)
    except BadCode as error:
        raise InvalidCommand(str(error)) from error
    if arguments.name and not re.fullmatch(NAME_PATTERN, arguments.name, re.ASCII):
        raise InvalidCommand(f"--name {arguments.name}: a name has 1 to 40 letters, digits, _ or -")
    addresses = [
        address for each in [*arguments.at, *filter(None, behind.split(","))] for address in resolve_address(each)
    ]
    path = arguments.folder / f"{arguments.files}.membership"
    if path.exists():
        # Do not use up the code if the result cannot be stored.
        raise InvalidCommand(
            f"{path} exists: this machine is a member; remove the file to join again, or pass --files NAME"
        )
    addresses = addresses or list(find_nodes())
    if not addresses:
        raise InvalidCommand("no bootstrap node was given, and none replies on the LAN; pass --at HOST:PORT")
    try:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        seed_file = arguments.folder / f".{arguments.files}.joining"
        membership = send_requests(
            code, _load_or_create_seed(seed_file, code, context), arguments.name, addresses, arguments.timeout
        )
    except BadKeyFile:
        raise
    except EntangledError as error:
        raise Rejection(str(error)) from error
    except OSError as error:
        raise InvalidCommand(f"cannot create {arguments.folder}: {error.strerror}") from error
    settings = arguments.folder / f"{arguments.files}.toml"
    name, roles = membership.member.name, membership.member.roles
    known = [f"[{host}]:{port}" if ":" in host else f"{host}:{port}" for host, port in membership.known_nodes]
    # The default host is loopback only; every address is used, because a laptop's addresses change.
    host = {} if all(is_loopback(address.host) for address in membership.known_nodes) else {"host": ANY_HOST}
    own = {**host, **({"tunnels": ["auto", *arguments.tunnel]} if arguments.tunnel else {})}
    given = {key: value for key, value in membership.settings.items() if key in SHARED_KEYS}
    text = format_settings(name, path.name, ["edge"], None, known, {**given, **own})
    is_kept = settings.exists() and settings.read_text(encoding="utf-8", errors="replace") != text
    write_settings(settings, text)
    # The membership is written last, so if it exists, the other files exist as well.
    memberships.create_membership_file(path, membership)
    seed_file.unlink(missing_ok=True)
    lines = [
        f"This machine is now {name}, a member of the team {membership.team} ({', '.join(roles)}).",
        f"  {path}  the membership: a secret of this node",
        f"  {settings}  its settings; start it by: twistd -n --pidfile= swarm-node --config {settings}",
    ]
    if is_kept:
        lines.append(f"{settings} existed and was not changed: check name and known_nodes in it")
    ignored = sorted(set(membership.settings) - set(given))
    if ignored:
        lines.append(f"Ignored settings of the invitation, which a team cannot set: {', '.join(map(repr, ignored))}")
    if membership.member.check_dates(context.wall()):
        lines.append("The clock of this machine or of the bootstrap node is wrong; set it before you start the node")
    answer = {"team": membership.team, "name": name, "roles": list(roles), "membership": str(path)}
    return {**answer, "settings": str(settings)}, lines


def _load_or_create_seed(path: Path, code: JoinCode, context: CommandContext) -> bytes:
    """Return the newcomer's key, stored at ``path`` before it is sent.

    After an interrupted join the same key is sent again, so the code is not used up twice.
    """
    invitation = code.key.public.hex()
    if path.exists():
        stored = keyfile.read(path)
        if stored.get("invitation") == invitation:
            try:
                return check_bytes(bytes.fromhex(stored["seed"]), 32)
            except (KeyError, ValueError, TypeError, RemoteError):
                pass
    seed = context.rng.randbytes(32)
    keyfile.write(path, {"kind": SEED_FILE_KIND, "invitation": invitation, "seed": seed.hex()})
    return seed


def resolve_address(text: str) -> list[Address]:
    """Resolve ``HOST:PORT``; raises ``InvalidCommand``."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InvalidCommand(f"{text!r} is not an address; write HOST:PORT")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise InvalidCommand(f"no address is known for {host!r}; fix the name, or write a numeric address") from error
    return list(dict.fromkeys(Address(str(each[4][0]), int(port)) for each in found))


def find_lan_nodes() -> list[Address]:
    """Return the nodes of any team that reply on the LAN; only nodes of the code's team accept the join request."""
    from swarmnode.doctor.measure import discover_on_lan

    return [each.address for each in discover_on_lan()]


def _make_join_function(tunnels: Sequence[str]) -> SendJoinRequests:
    """Return ``send_join_requests`` with ``tunnels`` and port 443 of each bootstrap node; raises ``InvalidCommand``."""
    try:
        named = Settings.from_mapping({"node": {"name": "newcomer", "tunnels": ["auto", *tunnels]}}, COMMAND_LINE)
    except BadSetting as error:
        raise InvalidCommand(f"--tunnel {' '.join(tunnels)}: {error.remedy}") from error
    return partial(send_join_requests, settings=named.node)


def send_join_requests(
    code: JoinCode,
    seed: bytes,
    wish: str,
    addresses: Sequence[Address],
    timeout: float,
    settings: NodeSettings,
) -> Membership:
    """Send join requests to ``addresses`` over UDP, in a separate reactor run; raises as ``JoinClient.join``.

    Without an early reply it also uses the tunnels of ``settings``, because a firewall may block UDP.
    """
    from middleware.entangled.clock import use_monotonic_time

    use_monotonic_time()
    import random

    from twisted.internet import reactor
    from twisted.internet.task import react

    from middleware.entangled.kademlia.alternate_path import FALLBACK_AFTER_S
    from middleware.entangled.network.udp import UdpNetwork
    from swarmnode.tunnels import add_tunnels

    outcome: list[Membership | EntangledError] = []

    def go(clock: Any) -> Deferred[None]:
        is_new = any(":" in each.host for each in addresses)
        rng = random.SystemRandom()
        udp = partial(UdpNetwork, clock, "::" if is_new else "0.0.0.0")
        network = add_tunnels(replace(settings, known_nodes=tuple(addresses)), udp, clock, rng, os.environ)()
        mapped = [
            Address(f"::ffff:{each.host}", each.port) if is_new and ":" not in each.host else each for each in addresses
        ]
        client = JoinClient(code, seed, network, clock, rng, wish)
        work = client.join(mapped, timeout)
        for address in find_alternate_paths(network):
            clock.callLater(FALLBACK_AFTER_S, client.add_address, address)

        def failed(failure: Any) -> None:
            failure.trap(EntangledError)
            outcome.append(failure.value)

        return work.addCallbacks(outcome.append, failed)

    try:
        react(go, (), reactor)
    except SystemExit as end:
        if end.code:
            sys.stderr.write("swarm join: interrupted; run the same command again\n")
            raise
    [found] = outcome
    if isinstance(found, EntangledError):
        raise found
    # A tunnel's address has no meaning for other nodes or after the next start.
    known = [
        *(addresses if found.known_nodes[0].is_virtual else ()),
        *(each for each in found.known_nodes if not each.is_virtual),
    ]
    plain = dict.fromkeys(Address(host.removeprefix("::ffff:"), port) for host, port in known)
    return replace(found, known_nodes=tuple(plain))
