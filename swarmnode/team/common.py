"""Common parts of the team verbs: operator's key, requests to a node, and the team's membership list."""

from __future__ import annotations

import argparse
import base64
import json
import os
import random
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from middleware.admission import operator as operators
from middleware.admission.certificate import Member
from middleware.admission.errors import BadKeyFile
from middleware.admission.membership_list import MembershipList
from middleware.admission.operator import Operator
from middleware.entangled.control.command import EXIT_FAILED, EXIT_USAGE, SendRequest, send_request
from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.control.socket_path import NoControl, find_socket
from middleware.entangled.errors import RemoteError
from middleware.entangled.wire.admission_check import EXPIRED
from swarmnode.control_client import Rejection

OPERATOR_VARIABLE = "SWARM_OPERATOR"
KEY_FILE_SUFFIX = ".operator"
UNIT_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86_400}


class InvalidCommand(Exception):
    """The command is wrong, independent of any node; ``str()`` is one line for display."""


@dataclass
class CommandContext:
    """The environment of a verb: output, control socket, clock and random generator; tests replace it."""

    out: TextIO = field(default_factory=lambda: sys.stdout)
    ask: SendRequest = send_request
    wall: Callable[[], float] = time.time
    rng: random.Random = field(default_factory=random.SystemRandom)


@dataclass(frozen=True)
class VerifiedTeam:
    """A node's view of its team, from signed entries that this command has verified."""

    team: str
    membership_list: MembershipList
    secret_number: int
    addresses: dict[bytes, str]
    bootstrap_addresses: tuple[str, ...]

    def list_members(self, now: float) -> list[Member]:
        """Return the members, by name."""
        return self.membership_list.list_members(now)

    def list_expired(self, now: float) -> list[Member]:
        """Return the members with an expired certificate that were not revoked."""
        return [each for each, refusal in self.membership_list.list_known_members(now) if refusal == EXPIRED]

    def find_member(self, name: str, now: float, has_expired: bool = False) -> Member:
        """Return the member with this name or key; ``has_expired`` allows expired members.  Raises ``Rejection``."""
        members = self.list_members(now)
        called = [each for each in members if name in (each.name, each.public.hex())]
        if not called and has_expired:
            called = [each for each in self.list_expired(now) if name in (each.name, each.public.hex())]
        if len(called) == 1:
            return called[0]
        if called:
            keys = ", ".join(each.public.hex() for each in called)
            raise Rejection(f"several members have the name {name}; use the key instead: {keys}")
        there = ", ".join(each.name for each in members) or "none"
        raise Rejection(f"no member has the name {name!r}; members: {there}")


def make_parser(
    prog: str, purpose: str, needs_key: bool = True, is_asked: bool = True, example: str = ""
) -> argparse.ArgumentParser:
    """Return the parser of a verb with the common options; with ``is_asked`` the verb sends requests to a node."""
    epilog = f"Example: swarm {prog} {example}".rstrip()
    verb_parser = argparse.ArgumentParser(prog=f"swarm {prog}", description=purpose, epilog=epilog)
    if is_asked:
        verb_parser.add_argument("--node", metavar="NAME", help="name of the node, if several run on this machine")
    verb_parser.add_argument("--json", action="store_true", help="print JSON, on one line")
    if needs_key:
        verb_parser.add_argument(
            "--operator",
            metavar="FILE",
            type=Path,
            help=f"operator's key (default: ${OPERATOR_VARIABLE}, or the only key)",
        )
    return verb_parser


Answer = tuple[Any, Sequence[str]]
"""The result of a verb: a value for programs, and lines of text."""


def run_verb(
    parser: argparse.ArgumentParser,
    words: Sequence[str] | None,
    context: CommandContext | None,
    work: Callable[[argparse.Namespace, CommandContext], Answer],
) -> int:
    """Parse the command line of a verb, run it, and print the result; returns the exit code."""
    context = context or CommandContext()
    arguments = parser.parse_args(words)
    try:
        answer, lines = work(arguments, context)
    except (Rejection, NoControl, InvalidCommand, BadKeyFile) as problem:
        sys.stderr.write(remove_control_characters(f"{parser.prog}: {problem}") + "\n")
        return EXIT_FAILED if isinstance(problem, Rejection) else EXIT_USAGE
    context.out.write(json.dumps(answer) + "\n" if arguments.json else "".join(f"{line}\n" for line in lines))
    return 0


def format_time(moment: float, has_time: bool = False) -> str:
    """Return a wall clock time as text."""
    return time.strftime("%Y-%m-%d %H:%M UTC" if has_time else "%Y-%m-%d", time.gmtime(moment))


def get_key_folder() -> Path:
    """Return the default folder of operators' keys."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "swarm-node"


def load_operator(named: Path | None) -> Operator:
    """Load the operator key from ``named`` (default: the only key); raises ``InvalidCommand`` or ``BadKeyFile``."""
    path = named or (Path(os.environ[OPERATOR_VARIABLE]) if os.environ.get(OPERATOR_VARIABLE) else None)
    if path is None:
        keys = sorted(get_key_folder().glob(f"*{KEY_FILE_SUFFIX}"))
        if len(keys) != 1:
            there = ", ".join(str(key) for key in keys)
            problem = f"there are several operators' keys ({there})" if keys else "there is no operator's key"
            raise InvalidCommand(f"{problem}; pass --operator FILE, or create a team by swarm init NAME")
        path = keys[0]
    return operators.load_operator(path)


def fetch_team(node: str | None, context: CommandContext, operator: Operator | None = None) -> VerifiedTeam:
    """Return a node's view of its team; raises ``Rejection`` if it is not the operator's team."""
    reply = _request(node, context, "team roll")
    public = bytes.fromhex(reply["operator"])
    if operator is not None and operator.public != public:
        raise Rejection(f"the node belongs to the team {reply['team']} of another operator; use that operator's key")
    members = MembershipList(public)
    for packed in reply["entries"]:
        try:
            members.add(base64.b64decode(packed), context.wall())
        except RemoteError as error:
            raise Rejection(f"the node's membership list has an entry that is not valid: {error}") from error
    addresses = {bytes.fromhex(key): address for key, address in reply["here"].items()}
    return VerifiedTeam(reply["team"], members, reply["secret"], addresses, tuple(reply["doors"]))


def publish_statement(node: str | None, context: CommandContext, statement: bytes) -> None:
    """Publish a signed statement through a node on this machine; raises ``Rejection``."""
    _request(node, context, "team tell", statement={"base64": base64.b64encode(statement).decode()})


def parse_duration(text: str) -> float:
    """Parse ``90s``, ``10m``, ``24h`` or ``7d`` as seconds; raises ``argparse.ArgumentTypeError``."""
    match = re.fullmatch(r"(\d{1,9})([smhd]?)", text)
    if match is None or int(match[1]) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration; write for example 90s, 10m, 24h or 7d")
    return float(int(match[1]) * UNIT_SECONDS[match[2] or "s"])


def format_duration(seconds: float) -> str:
    """Return a duration as text."""
    for unit, size in reversed(UNIT_SECONDS.items()):
        if seconds >= 2 * size or unit == "s":
            return f"{seconds / size:.0f} {unit}"
    return ""


def _request(node: str | None, context: CommandContext, verb: str, **given: Any) -> Any:
    for line in context.ask(find_socket(node), {"verb": verb, "with": given}):
        if "error" in line:
            raise Rejection(str(line.get("text", line["error"])))
        if "answer" in line:
            return line["answer"]
    raise Rejection("the node closed the connection without a reply; check the log of the node")
