"""``swarm promote``: give a member another role, effective immediately."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import ROLES
from swarmnode.team.common import (
    Answer,
    CommandContext,
    fetch_team,
    load_operator,
    make_parser,
    publish_statement,
    run_verb,
)


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Give a member another role; the role bootstrap lets it admit newcomers."
    promote = make_parser("promote", purpose, example="vaio --role bootstrap")
    promote.add_argument("name", metavar="NAME", help="name of the member")
    promote.add_argument("--role", choices=ROLES, default="bootstrap", help="role (default: bootstrap)")
    return run_verb(promote, words, context, _promote)


def _promote(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    operator = load_operator(arguments.operator)
    member = fetch_team(arguments.node, context, operator).find_member(arguments.name, context.wall())
    roles = tuple(dict.fromkeys([*member.roles, arguments.role]))
    # A grant must be later than the operator's previous grant; a certificate that is not renewable keeps its end.
    begin = max(int(context.wall()), member.since + 1)
    life = member.life if member.is_renewable else max(1, member.not_after - begin)
    publish_statement(arguments.node, context, operator.grant(member.public, member.name, roles, begin, life))
    return {"name": member.name, "roles": list(roles)}, [f"{member.name} now has the roles {', '.join(roles)}"]
