"""Rotate: ``swarm rotate``, a new secret for all members that stay."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import MAX_SEALED
from swarmnode.asker import Refusal
from swarmnode.team.office import Answer, Desk, known, operator_in, options, run, seconds, span, tell

GRACE = 7 * 86_400.0
"""Seconds for which the secret before is accepted, so that who was off meanwhile comes back.  Less is safer."""


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    rotate = options("rotate", "Give the team a new secret, as after a member was lost or revoked.")
    rotate.add_argument(
        "--grace", type=seconds, default=GRACE, metavar="TIME", help="how long the one before is accepted (7d)"
    )
    return run(rotate, words, desk, _rotated)


def _rotated(wishes: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(wishes.operator)
    found = known(wishes.node, desk, operator)
    members = found.members(desk.wall())
    if not members:
        raise Refusal("this team has no members that the node knows of")
    number = found.secret + 1
    keys = [each.public for each in members][:MAX_SEALED]
    tell(wishes.node, desk, operator.rotate(number, keys, desk.wall(), wishes.grace, desk.rng))
    names = [each.name for each in members]
    lines = [f"secret number {number} is for {', '.join(names)}", _until(wishes.grace)]
    return {"number": number, "members": names, "grace": wishes.grace}, lines


def _until(grace: float) -> str:
    return f"The one before is accepted for another {span(grace)}; who is off for longer has to join anew"
