"""``swarm promote``: give a member another role, effective immediately."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import ROLES
from swarmnode.team.office import Answer, Desk, known, operator_in, options, run, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Give a member another role; the role bootstrap lets it admit newcomers."
    promote = options("promote", purpose, example="vaio --role bootstrap")
    promote.add_argument("name", metavar="NAME", help="name of the member")
    promote.add_argument("--role", choices=ROLES, default="bootstrap", help="role (default: bootstrap)")
    return run(promote, words, desk, _promote)


def _promote(arguments: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(arguments.operator)
    member = known(arguments.node, desk, operator).member(arguments.name, desk.wall())
    roles = tuple(dict.fromkeys([*member.roles, arguments.role]))
    # The grant must be later than the operator's last one; a certificate that is not renewable keeps its end.
    begin = max(int(desk.wall()), member.since + 1)
    life = member.life if member.is_renewable else max(1, member.not_after - begin)
    tell(arguments.node, desk, operator.grant(member.public, member.name, roles, begin, life))
    return {"name": member.name, "roles": list(roles)}, [f"{member.name} now has the roles {', '.join(roles)}"]
