"""Init: ``swarm init``, which makes a closed team: its operator's key, and the membership of its first node."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from middleware.admission import membership as memberships
from middleware.admission import operator as operators
from middleware.admission.operator import FIRST
from middleware.admission.statement import ROLES
from middleware.entangled.network.interface import is_loopback
from middleware.entangled.network.network import EVERYWHERE
from middleware.errors import BadSetting
from middleware.settings import COMMAND_LINE, NODE_PORT, NodeSettings, Settings
from swarmnode.team.office import ENDING, Desk, Wrong, key_folder, options, run

MEMBERSHIP, SETTINGS = ".membership", ".toml"
ANYWHERE = f"{EVERYWHERE}:{NODE_PORT}"
"""Every address of the machine: what a laptop has today it may not have tomorrow."""


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    desk = desk or Desk()
    init = options(
        "init", "Make a closed team: the operator's key, and the membership of its first node.", is_asked=False
    )
    init.add_argument("team", metavar="NAME", help="what people call the team")
    init.add_argument("--first", metavar="NODE", default="bootstrap", help="name of the first node (bootstrap)")
    init.add_argument("--page", action="store_true", help="the first node serves the page, to its network as well")
    init.add_argument("--folder", metavar="DIR", type=Path, default=Path("."), help="where its files go (here)")
    init.add_argument(
        "--at", metavar="HOST:PORT", help=f"where the first node listens and newcomers knock (*:{NODE_PORT})"
    )
    init.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="a setting of [node] for all newcomers"
    )
    init.add_argument(
        "--member",
        metavar="NAME[=ROLE,...]",
        action="append",
        default=[],
        help="files for one more node at once, to be carried to it by hand; may be said again (device)",
    )
    wishes = init.parse_args(words)

    def work() -> tuple[Any, list[str]]:
        operator = operators.drawn(wishes.team, desk.rng)
        key = wishes.operator or key_folder() / f"{wishes.team}{ENDING}"
        first, settings = wishes.folder / f"{wishes.first}{MEMBERSHIP}", wishes.folder / f"{wishes.first}{SETTINGS}"
        team = team_settings(wishes.set)
        does = ["bootstrap", "edge", *(["web"] if wishes.page else [])]
        text = settings_text(wishes.first, first.name, does, wishes.at or ANYWHERE, (), team)
        others = {wishes.folder / f"{name}{MEMBERSHIP}": (name, roles) for name, roles in map(_member, wishes.member)}
        known = [wishes.at] if wishes.at else []
        host = {} if known and is_loopback(wishes.at.rpartition(":")[0]) else {"host": EVERYWHERE}
        texts = {
            path.with_suffix(SETTINGS): settings_text(name, path.name, ["edge"], None, known, {**host, **team})
            for path, (name, _) in others.items()
        }
        for path in (key, first, settings, *others, *texts):
            if path.exists():
                raise Wrong(f"{path} is there already; name another team, or --folder DIR")
        try:
            founded = operator.founded(wishes.first, FIRST, desk.wall(), desk.rng)
            secret, rest = founded.secrets[0][1], {}
            for path, (name, roles) in others.items():
                rest[path] = operator.founded(name, roles, desk.wall(), desk.rng, secret)
        except ValueError as error:
            raise Wrong(f"a member's name or role: {error}") from error
        try:
            key.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            wishes.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Wrong(f"{error.filename} cannot be made: {error.strerror}") from error
        operators.made(key, operator)
        for path, membership in {first: founded, **rest}.items():
            memberships.made(path, memberships.with_settings(membership, team))
        for path, words in {settings: text, **texts}.items():
            written(path, words)
        return {"team": wishes.team, "operator": str(key), "membership": str(first), "settings": str(settings)}, [
            f"The team {wishes.team} is made.",
            f"  {key}  the operator's key: it lets in and puts out; no node needs it. Keep a copy in a safe place.",
            f"  {first}  the first node's membership: a secret of that node",
            f"  {settings}  its settings; start it by: twistd -n --pidfile= swarm-node --config {settings}",
            *(
                f"  {path}  for {name} ({', '.join(roles)}): carry it and {name}{SETTINGS} there, and keep no copy"
                for path, (name, roles) in others.items()
            ),
            "Then let others in: swarm invite NAME",
        ]

    return run("init", work, wishes.json, desk.out)


def _member(text: str) -> tuple[str, list[str]]:
    name, _, roles = text.partition("=")
    found = roles.split(",") if roles else ["device"]
    unknown = [role for role in found if role not in ROLES]
    if unknown:
        raise Wrong(f"--member {text}: no role {unknown[0]!r}; there are {', '.join(ROLES)}")
    return name, found


def team_settings(given: Sequence[str]) -> dict[str, Any]:
    """The settings that ``KEY=VALUE`` mean, each held to the rule of its key; raises ``Wrong``."""
    found: dict[str, Any] = {}
    for each in given:
        key, sign, value = each.partition("=")
        if not sign or key in ("name", "membership", "team_key", "store"):
            raise Wrong(f"--set {each}: write KEY=VALUE, with a key of [node] that all can share")
        try:
            whole = Settings.from_mapping({"node": {"name": "any"}}, COMMAND_LINE).with_flags(**{key: value})
        except BadSetting as error:
            raise Wrong(str(error)) from error
        plain = getattr(whole.node, key, None)
        if not isinstance(plain, str | int | float | bool) or not hasattr(NodeSettings, key):
            raise Wrong(f"--set {each}: only numbers, words, true and false can be shared")
        found[key] = plain
    return found


def settings_text(
    name: str, membership: str, roles: Sequence[str], at: str | None, known: Sequence[str], team: dict[str, Any]
) -> str:
    """The text of a settings file for a new member; raises ``Wrong`` where a value is none."""
    lines = ["[node]", f'name = "{name}"', f'membership = "{membership}"', f'store = "{name}.sqlite"']
    lines.append(f"roles = {json.dumps(list(roles))}")
    if at is not None:
        host, colon, port = at.rpartition(":")
        if not colon or not port.isdecimal():
            raise Wrong(f"--at {at}: write HOST:PORT")
        team = {**team, "host": host.strip("[]"), "port": int(port)}
    if known:
        lines.append(f"known_nodes = {json.dumps(list(known))}")
    # JSON's words, numbers, true and false are lawful TOML.
    lines += [f"{key} = {json.dumps(value)}" for key, value in team.items()]
    if "web" in roles:
        lines += ["", "[web]", 'host = "0.0.0.0"']
    text = "\n".join(lines) + "\n"
    try:
        Settings.from_mapping(tomllib.loads(text), COMMAND_LINE)
    except BadSetting as error:
        raise Wrong(str(error)) from error
    return text


def written(path: Path, text: str) -> None:
    """Make a settings file; one that is there is left as it is.  Raises ``Wrong``."""
    try:
        # People write codes and passwords into it.
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return
    except OSError as error:
        raise Wrong(f"{path} cannot be written: {error.strerror}") from error


if __name__ == "__main__":
    raise SystemExit(main())
