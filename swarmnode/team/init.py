"""``swarm init``: create a closed team with its operator's key and the membership of its first node."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from middleware.admission import membership_file as memberships
from middleware.admission import operator as operators
from middleware.admission.membership_file import Membership
from middleware.admission.operator import FIRST_NODE_ROLES, Operator
from middleware.admission.statement import ROLES
from middleware.config.settings import COMMAND_LINE, NODE_PORT, Settings
from middleware.entangled.network.interface import is_loopback
from middleware.entangled.network.network import ANY_HOST
from middleware.errors import BadSetting
from swarmnode.team.common import (
    KEY_FILE_SUFFIX,
    Answer,
    CommandContext,
    InvalidCommand,
    get_key_folder,
    make_parser,
    run_verb,
)

MEMBERSHIP_SUFFIX, SETTINGS_SUFFIX = ".membership", ".toml"
SHARED_KEYS = ("port", "lan", "store_rows", "store_bytes", "durable", "presence_lease")
"""Keys of ``[node]`` that an operator may share with newcomers: none runs code, opens a page or grants a permission."""
ANY_ADDRESS = f"{ANY_HOST}:{NODE_PORT}"
"""Every address of the machine, because the addresses of a laptop change."""


@dataclass(frozen=True)
class _Member:
    """An initial member of the team, which needs no code; its two files are created in ``folder``."""

    name: str
    roles: Sequence[str]
    folder: Path

    @property
    def membership_path(self) -> Path:
        return self.folder / f"{self.name}{MEMBERSHIP_SUFFIX}"

    @property
    def settings_path(self) -> Path:
        return self.folder / f"{self.name}{SETTINGS_SUFFIX}"


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    init = make_parser(
        "init",
        "Create a closed team: the operator's key, and the membership of its first node.",
        is_asked=False,
        example="lab --first vaio --page",
    )
    init.add_argument("team", metavar="NAME", help="name of the team")
    init.add_argument("--first", metavar="NODE", default="bootstrap", help="name of the first node (bootstrap)")
    init.add_argument("--page", action="store_true", help="the first node serves the page to its whole network")
    init.add_argument(
        "--folder", metavar="DIR", type=Path, default=Path("."), help="folder for the files of the nodes (default: .)"
    )
    init.add_argument(
        "--at", metavar="HOST:PORT", help=f"address of the first node, also for newcomers (default: *:{NODE_PORT})"
    )
    init.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="setting of [node] for all newcomers; can be repeated",
    )
    init.add_argument(
        "--member",
        metavar="NAME[=ROLE,...]",
        action="append",
        default=[],
        help="create files for another node, to be copied to it; can be repeated (default role: device)",
    )
    return run_verb(init, words, context, _create)


def _create(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    operator = replace(
        operators.create_operator(arguments.team, context.rng), settings=parse_team_settings(arguments.set)
    )
    key = arguments.operator or get_key_folder() / f"{arguments.team}{KEY_FILE_SUFFIX}"
    team = dict(operator.settings)
    first = _Member(arguments.first, FIRST_NODE_ROLES, arguments.folder)
    members = [first]
    for text in arguments.member:
        member = _parse_member(text, arguments.folder)
        if member.name in {each.name for each in members}:
            raise InvalidCommand(f"--member {text}: another member has this name; choose another name")
        members.append(member)
    texts = _format_settings_files(members, arguments.at, arguments.page, team)
    for path in (key, *(each.membership_path for each in members), *texts):
        if path.exists():
            raise InvalidCommand(f"{path} exists already; choose another team name, or --folder DIR")
    created = _create_memberships(operator, members, context)
    _make_folders(key.parent, arguments.folder)
    operators.create_operator_file(key, operator)
    for path, membership in created.items():
        memberships.create_membership_file(path, replace(membership, settings=team))
    for path, text in texts.items():
        write_settings(path, text)
    answer = {"team": arguments.team, "operator": str(key)}
    return {**answer, "membership": str(first.membership_path), "settings": str(first.settings_path)}, [
        f"Created the team {arguments.team}.",
        f"  {key}  the operator's key: it admits and revokes members; no node needs it. Keep a copy in a safe place.",
        f"  {first.membership_path}  the first node's membership: a secret of that node",
        f"  {first.settings_path}  its settings; start it by: "
        f"twistd -n --pidfile= swarm-node --config {first.settings_path}",
        *(
            f"  {each.membership_path}  for {each.name} ({', '.join(each.roles)}): "
            f"copy it and {each.settings_path.name} to that node, then delete them here"
            for each in members[1:]
        ),
        "Next, admit other nodes: swarm invite NAME",
    ]


def _parse_member(text: str, folder: Path) -> _Member:
    name, _, roles = text.partition("=")
    found = roles.split(",") if roles else ["device"]
    unknown = [role for role in found if role not in ROLES]
    if unknown:
        raise InvalidCommand(f"--member {text}: no role {unknown[0]!r}; roles: {', '.join(ROLES)}")
    return _Member(name, found, folder)


def _format_settings_files(
    members: Sequence[_Member], at: str | None, has_page: bool, team: Mapping[str, Any]
) -> dict[Path, str]:
    """Return the settings files: the first node listens at ``at``, and the others have it as a known node."""
    first, *others = members
    does = ["bootstrap", "edge", *(["web"] if has_page else [])]
    texts = {
        first.settings_path: format_settings(first.name, first.membership_path.name, does, at or ANY_ADDRESS, (), team)
    }
    known = [at] if at else []
    host = {} if at and is_loopback(at.rpartition(":")[0]) else {"host": ANY_HOST}
    for each in others:
        texts[each.settings_path] = format_settings(
            each.name, each.membership_path.name, ["edge"], None, known, {**host, **team}
        )
    return texts


def _create_memberships(
    operator: Operator, members: Sequence[_Member], context: CommandContext
) -> dict[Path, Membership]:
    """Return the memberships, all with the same team secret; raises ``InvalidCommand``."""
    found: dict[Path, Membership] = {}
    secret = None
    for each in members:
        try:
            membership = operator.create_membership(each.name, each.roles, context.wall(), context.rng, secret)
        except ValueError as error:
            raise InvalidCommand(f"a member's name or role is not valid: {error}") from error
        found[each.membership_path] = membership
        secret = membership.secrets[0][1]
    return found


def _make_folders(keys: Path, members: Path) -> None:
    try:
        keys.mkdir(mode=0o700, parents=True, exist_ok=True)
        members.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidCommand(f"cannot create {error.filename}: {error.strerror}") from error


def parse_team_settings(given: Sequence[str]) -> dict[str, Any]:
    """Parse ``KEY=VALUE`` settings and check each by the rule of its key; raises ``InvalidCommand``."""
    found: dict[str, Any] = {}
    for each in given:
        key, sign, value = each.partition("=")
        if not sign or key not in SHARED_KEYS:
            raise InvalidCommand(f"--set {each} is not KEY=VALUE with one of the keys {', '.join(SHARED_KEYS)}")
        try:
            whole = Settings.from_mapping({"node": {"name": "any"}}, COMMAND_LINE).with_flags(**{key: value})
        except BadSetting as error:
            raise InvalidCommand(str(error)) from error
        found[key] = getattr(whole.node, key)
    return found


def format_settings(
    name: str, membership: str, roles: Sequence[str], at: str | None, known: Sequence[str], team: Mapping[str, Any]
) -> str:
    """Return the text of a settings file for a new member; raises ``InvalidCommand`` for an invalid value."""
    import tomli_w

    node: dict[str, Any] = {"name": name, "membership": membership, "store": f"{name}.sqlite", "roles": list(roles)}
    if known:
        node["known_nodes"] = list(known)
    node.update(team)
    if at is not None:
        host, colon, port = at.rpartition(":")
        if not colon or not port.isdecimal():
            raise InvalidCommand(f"--at {at} is not HOST:PORT")
        node.update(host=host.strip("[]"), port=int(port))
    tables = {"node": node, **({"web": {"host": "0.0.0.0"}} if "web" in roles else {})}
    try:
        Settings.from_mapping(tables, COMMAND_LINE)
    except BadSetting as error:
        raise InvalidCommand(str(error)) from error
    return tomli_w.dumps(tables)


def write_settings(path: Path, text: str) -> None:
    """Create a settings file, unless it exists; raises ``InvalidCommand``."""
    try:
        # Private, because users may add codes and passwords.
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return
    except OSError as error:
        raise InvalidCommand(f"cannot write {path}: {error.strerror}") from error


if __name__ == "__main__":
    raise SystemExit(main())
