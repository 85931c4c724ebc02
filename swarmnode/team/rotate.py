"""``swarm rotate``: replace the team's secret for all current members."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import MAX_SECRET_RECIPIENTS
from swarmnode.control_client import Rejection
from swarmnode.team.common import (
    Answer,
    CommandContext,
    fetch_team,
    format_duration,
    load_operator,
    make_parser,
    parse_duration,
    publish_statement,
    run_verb,
)

GRACE_S = 7 * 86_400.0
"""Seconds for which the previous secret is accepted, so offline members can return.  A shorter time is safer."""


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Replace the team's secret, for example after a member was lost or revoked."
    rotate = make_parser("rotate", purpose, example="--grace 7d")
    rotate.add_argument(
        "--grace",
        type=parse_duration,
        default=GRACE_S,
        metavar="TIME",
        help="validity of the previous secret (default: 7d)",
    )
    return run_verb(rotate, words, context, _rotate)


def _rotate(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    operator = load_operator(arguments.operator)
    found = fetch_team(arguments.node, context, operator)
    members = found.list_members(context.wall())
    if not members:
        raise Rejection("the node knows no members of this team; check it by swarm doctor")
    number = found.secret_number + 1
    keys = [each.public for each in members][:MAX_SECRET_RECIPIENTS]
    publish_statement(
        arguments.node, context, operator.rotate_secret(number, keys, context.wall(), arguments.grace, context.rng)
    )
    names = [each.name for each in members]
    lines = [f"created secret number {number} for {', '.join(names)}", _describe_grace(arguments.grace)]
    return {"number": number, "members": names, "grace": arguments.grace}, lines


def _describe_grace(grace: float) -> str:
    accepted = format_duration(grace)
    return f"The previous secret is accepted for {accepted}; members that are offline longer have to join again"
