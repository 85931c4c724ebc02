"""Office: what the operator's verbs have in common: the key, the node that is asked, and what it says of the team."""

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
    """A command that no node need be asked about; ``str()`` is one line for a person."""


@dataclass
class Desk:
    """Where a verb's words come from and go to, and the world that it needs; tests hand in their own."""

    out: TextIO = field(default_factory=lambda: sys.stdout)
    ask: Ask = asked
    wall: Callable[[], float] = time.time
    rng: random.Random = field(default_factory=random.SystemRandom)


@dataclass(frozen=True)
class Known:
    """What a node of this machine says of its team; all of it is signed, and was checked here."""

    team: str
    roll: Roll
    secret: int
    here: dict[bytes, str]
    doors: tuple[str, ...]

    def members(self, now: float) -> list[Member]:
        """All members, by name."""
        return self.roll.members(now)

    def expired(self, now: float) -> list[Member]:
        """Those whose certificates have ended, and that the operator did not revoke."""
        return [each for each, refusal in self.roll.remembered(now) if refusal == EXPIRED]

    def member(self, name: str, now: float, has_expired: bool = False) -> Member:
        """The member that is called so, or else, where ``has_expired``, one that has; raises ``Refusal``."""
        members = self.members(now)
        called = [each for each in members if name in (each.name, each.public.hex())]
        if not called and has_expired:
            called = [each for each in self.expired(now) if name in (each.name, each.public.hex())]
        if len(called) == 1:
            return called[0]
        if called:
            keys = ", ".join(each.public.hex() for each in called)
            raise Refusal(f"several members are called {name}; say which by its key: {keys}")
        there = ", ".join(each.name for each in members) or "nobody"
        raise Refusal(f"no member is called {name!r}; there are {there}")


def options(prog: str, purpose: str, needs_key: bool = True, is_asked: bool = True) -> argparse.ArgumentParser:
    """The beginning of each verb's command line; ``is_asked`` where a node of this machine is asked."""
    whole = argparse.ArgumentParser(prog=f"swarm {prog}", description=purpose)
    if is_asked:
        whole.add_argument("--node", metavar="NAME", help="through which node of this machine, where several run")
    whole.add_argument("--json", action="store_true", help="answer in JSON, on one line")
    if needs_key:
        whole.add_argument(
            "--operator", metavar="FILE", type=Path, help=f"the operator's key; else ${VARIABLE}, or the only one here"
        )
    return whole


Answer = tuple[Any, Sequence[str]]
"""The answer of a verb: a value for programs, and lines for people."""


def run(
    parser: argparse.ArgumentParser,
    words: Sequence[str] | None,
    desk: Desk | None,
    work: Callable[[argparse.Namespace, Desk], Answer],
) -> int:
    """Read the command line of a verb, do its work, and print the answer; returns the exit code."""
    desk = desk or Desk()
    wishes = parser.parse_args(words)
    try:
        answer, lines = work(wishes, desk)
    except (Refusal, NoControl, Wrong, BadKeyFile) as problem:
        sys.stderr.write(printable(f"{parser.prog}: {problem}") + "\n")
        return FAILED if isinstance(problem, Refusal) else WRONG
    desk.out.write(json.dumps(answer) + "\n" if wishes.json else "".join(f"{line}\n" for line in lines))
    return 0


def day(moment: float, has_time: bool = False) -> str:
    """A moment of the wall clock, for people."""
    return time.strftime("%Y-%m-%d %H:%M UTC" if has_time else "%Y-%m-%d", time.gmtime(moment))


def key_folder() -> Path:
    """Where an operator's keys lie unless they are put elsewhere."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "swarm-node"


def operator_in(named: Path | None) -> Operator:
    """The operator whose key is named, or the only one here; raises ``Wrong`` or ``BadKeyFile``."""
    path = named or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if path is None:
        keys = sorted(key_folder().glob(f"*{ENDING}"))
        if len(keys) != 1:
            there = ", ".join(str(key) for key in keys)
            problem = f"several operators' keys are here ({there})" if keys else "no operator's key is here"
            raise Wrong(f"{problem}; say --operator FILE, or make a team by swarm init NAME")
        path = keys[0]
    return operators.load(path)


def known(node: str | None, desk: Desk, operator: Operator | None = None) -> Known:
    """What a node of this machine says of its team; raises ``Refusal`` where that is not the operator's."""
    told = _answer(node, desk, "team roll")
    public = bytes.fromhex(told["operator"])
    if operator is not None and operator.public != public:
        raise Refusal(f"the node belongs to the team {told['team']} of another operator; take that one's key")
    roll = Roll(public)
    for packed in told["entries"]:
        try:
            roll.add(base64.b64decode(packed), desk.wall())
        except RemoteError as error:
            raise Refusal(f"the node tells of its team what the operator never signed: {error}") from error
    here = {bytes.fromhex(key): address for key, address in told["here"].items()}
    return Known(told["team"], roll, told["secret"], here, tuple(told["doors"]))


def tell(node: str | None, desk: Desk, statement: bytes) -> None:
    """Let a node of this machine tell the team what was signed; raises ``Refusal``."""
    _answer(node, desk, "team tell", statement={"base64": base64.b64encode(statement).decode()})


def seconds(text: str) -> float:
    """The seconds that ``90s``, ``10m``, ``24h`` or ``7d`` mean; raises as argparse wants it."""
    match = re.fullmatch(r"(\d{1,9})([smhd]?)", text)
    if match is None or int(match[1]) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no span of time; write 90s, 10m, 24h or 7d")
    return float(int(match[1]) * SPANS[match[2] or "s"])


def span(seconds: float) -> str:
    """A span of time for people."""
    for unit, size in reversed(SPANS.items()):
        if seconds >= 2 * size or unit == "s":
            return f"{seconds / size:.0f} {unit}"
    return ""


def _answer(node: str | None, desk: Desk, verb: str, **given: Any) -> Any:
    for line in desk.ask(found(node), {"verb": verb, "with": given}):
        if "error" in line:
            raise Refusal(str(line.get("text", line["error"])))
        if "answer" in line:
            return line["answer"]
    raise Refusal("the node closed the connection without an answer")
