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
from middleware.admission.operator import Operator
from middleware.admission.roll import Roll
from middleware.entangled.control.command import FAILED, WRONG, Ask, asked
from middleware.entangled.control.place import NoControl, found
from middleware.entangled.control.word import printable
from middleware.entangled.errors import RemoteError
from middleware.entangled.wire.door import EXPIRED
from swarmnode.asker import Refusal

VARIABLE = "SWARM_OPERATOR"
ENDING = ".operator"
SPANS = {"s": 1, "m": 60, "h": 3600, "d": 86_400}


class Wrong(Exception):
    """The command is wrong, independent of any node; ``str()`` is one line for display."""


@dataclass
class Desk:
    """The environment of a verb: output, control socket, clock and random generator; tests replace it."""

    out: TextIO = field(default_factory=lambda: sys.stdout)
    ask: Ask = asked
    wall: Callable[[], float] = time.time
    rng: random.Random = field(default_factory=random.SystemRandom)


@dataclass(frozen=True)
class Known:
    """A node's view of its team; all of it is signed and was verified here."""

    team: str
    roll: Roll
    secret: int
    here: dict[bytes, str]
    doors: tuple[str, ...]

    def members(self, now: float) -> list[Member]:
        """Return the members, by name."""
        return self.roll.members(now)

    def expired(self, now: float) -> list[Member]:
        """Return the members with an expired certificate that were not revoked."""
        return [each for each, refusal in self.roll.remembered(now) if refusal == EXPIRED]

    def member(self, name: str, now: float, has_expired: bool = False) -> Member:
        """Return the member with that name or key, with ``has_expired`` also an expired one; raises ``Refusal``."""
        members = self.members(now)
        called = [each for each in members if name in (each.name, each.public.hex())]
        if not called and has_expired:
            called = [each for each in self.expired(now) if name in (each.name, each.public.hex())]
        if len(called) == 1:
            return called[0]
        if called:
            keys = ", ".join(each.public.hex() for each in called)
            raise Refusal(f"several members have the name {name}; use the key instead: {keys}")
        there = ", ".join(each.name for each in members) or "none"
        raise Refusal(f"no member has the name {name!r}; members: {there}")


def options(
    prog: str, purpose: str, needs_key: bool = True, is_asked: bool = True, example: str = ""
) -> argparse.ArgumentParser:
    """Return the parser of a verb with the common options; ``is_asked``: the verb sends requests to a node."""
    epilog = f"Example: swarm {prog} {example}".rstrip()
    verb_parser = argparse.ArgumentParser(prog=f"swarm {prog}", description=purpose, epilog=epilog)
    if is_asked:
        verb_parser.add_argument("--node", metavar="NAME", help="node on this machine, if several run")
    verb_parser.add_argument("--json", action="store_true", help="print JSON, on one line")
    if needs_key:
        verb_parser.add_argument(
            "--operator", metavar="FILE", type=Path, help=f"operator's key (default: ${VARIABLE}, or the only key)"
        )
    return verb_parser


Answer = tuple[Any, Sequence[str]]
"""The result of a verb: a value for programs, and lines of text."""


def run(
    parser: argparse.ArgumentParser,
    words: Sequence[str] | None,
    desk: Desk | None,
    work: Callable[[argparse.Namespace, Desk], Answer],
) -> int:
    """Parse the command line of a verb, run it, and print the result; returns the exit code."""
    desk = desk or Desk()
    arguments = parser.parse_args(words)
    try:
        answer, lines = work(arguments, desk)
    except (Refusal, NoControl, Wrong, BadKeyFile) as problem:
        sys.stderr.write(printable(f"{parser.prog}: {problem}") + "\n")
        return FAILED if isinstance(problem, Refusal) else WRONG
    desk.out.write(json.dumps(answer) + "\n" if arguments.json else "".join(f"{line}\n" for line in lines))
    return 0


def day(moment: float, has_time: bool = False) -> str:
    """Return a wall clock time as text."""
    return time.strftime("%Y-%m-%d %H:%M UTC" if has_time else "%Y-%m-%d", time.gmtime(moment))


def key_folder() -> Path:
    """Return the default folder of operators' keys."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "swarm-node"


def operator_in(named: Path | None) -> Operator:
    """Load the named operator's key, or the only one on this machine; raises ``Wrong`` or ``BadKeyFile``."""
    path = named or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if path is None:
        keys = sorted(key_folder().glob(f"*{ENDING}"))
        if len(keys) != 1:
            there = ", ".join(str(key) for key in keys)
            problem = f"there are several operators' keys ({there})" if keys else "there is no operator's key"
            raise Wrong(f"{problem}; pass --operator FILE, or create a team by swarm init NAME")
        path = keys[0]
    return operators.load(path)


def known(node: str | None, desk: Desk, operator: Operator | None = None) -> Known:
    """Return a node's view of its team; raises ``Refusal`` if it is not the operator's team."""
    reply = _request(node, desk, "team roll")
    public = bytes.fromhex(reply["operator"])
    if operator is not None and operator.public != public:
        raise Refusal(f"the node belongs to the team {reply['team']} of another operator; use that operator's key")
    roll = Roll(public)
    for packed in reply["entries"]:
        try:
            roll.add(base64.b64decode(packed), desk.wall())
        except RemoteError as error:
            raise Refusal(f"the node's membership list has an entry that is not valid: {error}") from error
    here = {bytes.fromhex(key): address for key, address in reply["here"].items()}
    return Known(reply["team"], roll, reply["secret"], here, tuple(reply["doors"]))


def tell(node: str | None, desk: Desk, statement: bytes) -> None:
    """Publish a signed statement through a node on this machine; raises ``Refusal``."""
    _request(node, desk, "team tell", statement={"base64": base64.b64encode(statement).decode()})


def seconds(text: str) -> float:
    """Parse ``90s``, ``10m``, ``24h`` or ``7d`` as seconds; raises ``argparse.ArgumentTypeError``."""
    match = re.fullmatch(r"(\d{1,9})([smhd]?)", text)
    if match is None or int(match[1]) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration; write 90s, 10m, 24h or 7d")
    return float(int(match[1]) * SPANS[match[2] or "s"])


def span(seconds: float) -> str:
    """Return a duration as text."""
    for unit, size in reversed(SPANS.items()):
        if seconds >= 2 * size or unit == "s":
            return f"{seconds / size:.0f} {unit}"
    return ""


def _request(node: str | None, desk: Desk, verb: str, **given: Any) -> Any:
    for line in desk.ask(found(node), {"verb": verb, "with": given}):
        if "error" in line:
            raise Refusal(str(line.get("text", line["error"])))
        if "answer" in line:
            return line["answer"]
    raise Refusal("the node closed the connection without a reply; check the log of the node")
