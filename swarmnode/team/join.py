"""Join: ``swarm join CODE``, by which this machine becomes a member of a closed team."""

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

from middleware.admission import code as codes
from middleware.admission import keyfile
from middleware.admission import membership as memberships
from middleware.admission.code import Code
from middleware.admission.errors import BadCode, BadKeyFile
from middleware.admission.membership import Membership
from middleware.admission.newcomer import PATIENCE, Newcomer
from middleware.admission.statement import NAME, sized
from middleware.config.settings import COMMAND_LINE, NodeSettings, Settings
from middleware.entangled.errors import EntangledError, RemoteError
from middleware.entangled.network.interface import is_loopback
from middleware.entangled.network.network import EVERYWHERE, Address
from middleware.errors import BadSetting
from swarmnode.asker import Refusal
from swarmnode.team.init import SHARED, settings_text, written
from swarmnode.team.office import Answer, Desk, Wrong, options, run, seconds

JOINING = "swarm-node joining 1"
Knocking = Callable[[Code, bytes, str, Sequence[Address], float], Membership]
Around = Callable[[], Sequence[Address]]


def main(
    words: Sequence[str] | None = None,
    desk: Desk | None = None,
    knocking: Knocking | None = None,
    around: Around | None = None,
) -> int:
    """Run the command; returns its exit code."""
    join = options("join", "Become a member of a closed team, by a code of its operator.", False, is_asked=False)
    join.add_argument("code", metavar="CODE", help="as swarm invite shows it, with or without @HOST:PORT behind it")
    join.add_argument(
        "--at", metavar="HOST:PORT", action="append", default=[], help="a bootstrap node to ask (else: who is here)"
    )
    join.add_argument(
        "--tunnel", metavar="URL", action="append", default=[], help="wss://HOST:PORT, where UDP is blocked (port 443)"
    )
    join.add_argument("--name", metavar="NAME", default="", help="what to be called, where the code leaves that open")
    join.add_argument("--folder", metavar="DIR", type=Path, default=Path("."), help="where the files go (here)")
    join.add_argument("--files", metavar="NAME", default="swarm", help="what they are called (swarm)")
    join.add_argument("--timeout", type=seconds, default=PATIENCE, metavar="TIME", help="how long to try (20s)")

    def work(wishes: argparse.Namespace, desk: Desk) -> Answer:
        return _joined(wishes, desk, knocking or _knocking(wishes.tunnel), around or on_the_lan)

    return run(join, words, desk, work)


def _joined(wishes: argparse.Namespace, desk: Desk, knocking: Knocking, around: Around) -> Answer:
    text, _, behind = wishes.code.partition("@")
    try:
        code = codes.read(text)
    except BadCode as error:
        raise Wrong(str(error)) from error
    if wishes.name and not re.fullmatch(NAME, wishes.name, re.ASCII):
        raise Wrong(f"--name {wishes.name}: a name has 1 to 40 letters, digits, _ or -")
    doors = [address for each in [*wishes.at, *filter(None, behind.split(","))] for address in addresses(each)]
    path = wishes.folder / f"{wishes.files}.membership"
    if path.exists():
        # A code is good for one: it is not spent on what cannot be kept.
        raise Wrong(f"{path} is there already: this is a member; remove it to join anew, or say --files NAME")
    doors = doors or list(around())
    if not doors:
        raise Wrong("nobody is named to ask, and none answers on this network; say --at HOST:PORT of a bootstrap node")
    try:
        wishes.folder.mkdir(parents=True, exist_ok=True)
        begun = wishes.folder / f".{wishes.files}.joining"
        membership = knocking(code, _seed(begun, code, desk), wishes.name, doors, wishes.timeout)
    except BadKeyFile:
        raise
    except EntangledError as error:
        raise Refusal(str(error)) from error
    except OSError as error:
        raise Wrong(f"{wishes.folder} cannot be made: {error.strerror}") from error
    settings = wishes.folder / f"{wishes.files}.toml"
    name, roles = membership.member.name, membership.member.roles
    known = [f"[{host}]:{port}" if ":" in host else f"{host}:{port}" for host, port in membership.known]
    # Without a host it would hear its own machine alone; by every address, since a laptop has another one tomorrow.
    host = {} if all(is_loopback(address.host) for address in membership.known) else {"host": EVERYWHERE}
    own = {**host, **({"tunnels": ["auto", *wishes.tunnel]} if wishes.tunnel else {})}
    given = {key: value for key, value in membership.settings.items() if key in SHARED}
    text = settings_text(name, path.name, ["edge"], None, known, {**given, **own})
    is_kept = settings.exists() and settings.read_text(encoding="utf-8", errors="replace") != text
    written(settings, text)
    # The membership comes last: who finds it has all the rest.
    memberships.made(path, membership)
    begun.unlink(missing_ok=True)
    lines = [
        f"This is {name} now, a member of the team {membership.team} ({', '.join(roles)}).",
        f"  {path}  the membership: a secret of this node",
        f"  {settings}  its settings; start it by: twistd -n --pidfile= swarm-node --config {settings}",
    ]
    if is_kept:
        lines.append(f"{settings} was there already and is left as it is: see that its name and known_nodes are right")
    ignored = sorted(set(membership.settings) - set(given))
    if ignored:
        lines.append(f"Ignored settings of the invitation, which a team cannot give: {', '.join(map(repr, ignored))}")
    if membership.member.trouble(desk.wall()):
        lines.append(
            "The clock of this machine, or that of the bootstrap node, is wrong; set it right before the start"
        )
    answer = {"team": membership.team, "name": name, "roles": list(roles), "membership": str(path)}
    return {**answer, "settings": str(settings)}, lines


def _seed(path: Path, code: Code, desk: Desk) -> bytes:
    """The newcomer's key, kept at ``path`` before anybody hears of it.

    So who is let in and killed before that is kept can say the same again: its code is not spent on nobody.
    """
    invitation = code.key.public.hex()
    if path.exists():
        kept = keyfile.read(path)
        if kept.get("invitation") == invitation:
            try:
                return sized(bytes.fromhex(kept["seed"]), 32)
            except (KeyError, ValueError, TypeError, RemoteError):
                pass
    seed = desk.rng.randbytes(32)
    keyfile.write(path, {"kind": JOINING, "invitation": invitation, "seed": seed.hex()})
    return seed


def addresses(text: str) -> list[Address]:
    """The addresses that ``HOST:PORT`` means; raises ``Wrong``."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdecimal() or not 0 < int(port) < 65536:
        raise Wrong(f"{text!r} is no address; write HOST:PORT")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise Wrong(f"no address is known for {host!r}; mend the name, or write it in figures") from error
    return list(dict.fromkeys(Address(str(each[4][0]), int(port)) for each in found))


def on_the_lan() -> list[Address]:
    """Who answers on the LAN, of whatever team: only the code's own team can open."""
    from swarmnode.doctor.measure import on_lan

    return [each.address for each in on_lan()]


def _knocking(tunnels: Sequence[str]) -> Knocking:
    """``knocked`` by these tunnels as well, and as ever by port 443 of each door; raises ``Wrong``."""
    try:
        named = Settings.from_mapping({"node": {"name": "newcomer", "tunnels": ["auto", *tunnels]}}, COMMAND_LINE)
    except BadSetting as error:
        raise Wrong(f"--tunnel {' '.join(tunnels)}: {error.remedy}") from error
    return partial(knocked, settings=named.node)


def knocked(
    code: Code,
    seed: bytes,
    wish: str,
    doors: Sequence[Address],
    timeout: float,
    settings: NodeSettings,
) -> Membership:
    """Knock at ``doors`` over UDP, on a reactor of its own; raises what ``Newcomer.join`` fails with.

    Where nobody answers soon, also by the tunnels of ``settings``: a firewall may let nothing else out.
    """
    from middleware.entangled.clock import use_monotonic_time

    use_monotonic_time()
    import random

    from twisted.internet import reactor
    from twisted.internet.task import react

    from middleware.entangled.kademlia.detour import AFTER_S
    from middleware.entangled.network.udp import UdpNetwork
    from swarmnode.tunnels import with_tunnels

    outcome: list[Membership | EntangledError] = []

    def go(clock: Any) -> Deferred[None]:
        is_new = any(":" in door.host for door in doors)
        rng = random.SystemRandom()
        udp = partial(UdpNetwork, clock, "::" if is_new else "0.0.0.0")
        network = with_tunnels(replace(settings, known_nodes=tuple(doors)), udp, clock, rng, os.environ)()
        mapped = [
            Address(f"::ffff:{each.host}", each.port) if is_new and ":" not in each.host else each for each in doors
        ]
        newcomer = Newcomer(code, seed, network, clock, rng, wish)
        work = newcomer.join(mapped, timeout)
        for way in getattr(network, "detours", ()):
            clock.callLater(AFTER_S, newcomer.add, way)

        def failed(failure: Any) -> None:
            failure.trap(EntangledError)
            outcome.append(failure.value)

        return work.addCallbacks(outcome.append, failed)

    try:
        react(go, (), reactor)
    except SystemExit as end:
        if end.code:
            sys.stderr.write("swarm join: it was interrupted; say the same again\n")
            raise
    [found] = outcome
    if isinstance(found, EntangledError):
        raise found
    # A tunnel's address means nothing to others, and nothing after the next start.
    known = [*(doors if found.known[0].is_virtual else ()), *(each for each in found.known if not each.is_virtual)]
    plain = dict.fromkeys(Address(host.removeprefix("::ffff:"), port) for host, port in known)
    return replace(found, known=tuple(plain))
