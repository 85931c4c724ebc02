"""``swarm rotate``: replace the team's secret for all current members."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import MAX_SEALED
from swarmnode.asker import Refusal
from swarmnode.team.office import Answer, Desk, known, operator_in, options, run, seconds, span, tell

GRACE = 7 * 86_400.0
"""Seconds for which the previous secret is accepted, so offline members can return.  Less is safer."""


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Replace the team's secret, for example after a member was lost or revoked."
    rotate = options("rotate", purpose, example="--grace 7d")
    rotate.add_argument(
        "--grace", type=seconds, default=GRACE, metavar="TIME", help="validity of the previous secret (default: 7d)"
    )
    return run(rotate, words, desk, _rotate)


def _rotate(arguments: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(arguments.operator)
    found = known(arguments.node, desk, operator)
    members = found.members(desk.wall())
    if not members:
        raise Refusal("the node knows no members of this team; check it by swarm doctor")
    number = found.secret + 1
    keys = [each.public for each in members][:MAX_SEALED]
    tell(arguments.node, desk, operator.rotate(number, keys, desk.wall(), arguments.grace, desk.rng))
    names = [each.name for each in members]
    lines = [f"created secret number {number} for {', '.join(names)}", _describe_grace(arguments.grace)]
    return {"number": number, "members": names, "grace": arguments.grace}, lines


def _describe_grace(grace: float) -> str:
    return f"The previous secret is accepted for {span(grace)}; members that are offline longer have to join again"
