"""``swarm renew``: issue a new certificate for a member's key, even after the old certificate has expired."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import DEFAULT_LIFE_S
from swarmnode.team.common import (
    Answer,
    CommandContext,
    fetch_team,
    format_time,
    load_operator,
    make_parser,
    parse_duration,
    publish_statement,
    run_verb,
)


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Renew the certificate of a member with the same key, name and roles, even after its expiry."
    renew = make_parser("renew", purpose, example="dog1 --for 365d")
    renew.add_argument("name", metavar="NAME", help="name of the member, or its key in hexadecimal")
    renew.add_argument(
        "--for",
        dest="life",
        type=parse_duration,
        default=float(DEFAULT_LIFE_S),
        metavar="TIME",
        help="validity (default: 365d)",
    )
    return run_verb(renew, words, context, _renew)


def _renew(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    operator = load_operator(arguments.operator)
    member = fetch_team(arguments.node, context, operator).find_member(arguments.name, context.wall(), has_expired=True)
    # A grant must be later than the operator's previous grant.
    begin = max(int(context.wall()), member.since + 1)
    publish_statement(
        arguments.node, context, operator.grant(member.public, member.name, member.roles, begin, arguments.life)
    )
    end = begin + int(arguments.life)
    renews = arguments.life >= DEFAULT_LIFE_S
    how = "bootstrap nodes renew it automatically" if renews else "it is not renewed automatically"
    return {"name": member.name, "roles": list(member.roles), "until": end, "renews": renews}, [
        f"{member.name} has a certificate until {format_time(end)}; {how}"
    ]
