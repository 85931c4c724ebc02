"""Promote: ``swarm promote``, one more role for a member, at once: as bootstrap it lets others in."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import ROLES
from swarmnode.team.office import Answer, Desk, known, operator_in, options, run, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    promote = options("promote", "Give a member one more role; without --role, that of a bootstrap node.")
    promote.add_argument("name", metavar="NAME", help="of the member")
    promote.add_argument("--role", choices=ROLES, default="bootstrap", help="which role (bootstrap)")
    return run(promote, words, desk, _promoted)


def _promoted(wishes: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(wishes.operator)
    member = known(wishes.node, desk, operator).member(wishes.name, desk.wall())
    roles = tuple(dict.fromkeys([*member.roles, wishes.role]))
    # Later than the operator's last word, or it would not hold; what is not renewed ends when it did.
    begin = max(int(desk.wall()), member.since + 1)
    life = member.life if member.is_renewable else max(1, member.not_after - begin)
    tell(wishes.node, desk, operator.grant(member.public, member.name, roles, begin, life))
    return {"name": member.name, "roles": list(roles)}, [f"{member.name} is now {', '.join(roles)}"]
