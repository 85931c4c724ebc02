"""``swarm renew``: issue a new certificate for a member's key, also for an expired one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import YEAR
from swarmnode.team.office import Answer, Desk, day, known, operator_in, options, run, seconds, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Renew the certificate of a member, with the same key, name and roles; also an expired one."
    renew = options("renew", purpose, example="dog1 --for 365d")
    renew.add_argument("name", metavar="NAME", help="name of the member, or its key in hexadecimal")
    renew.add_argument(
        "--for", dest="life", type=seconds, default=float(YEAR), metavar="TIME", help="validity (default: 365d)"
    )
    return run(renew, words, desk, _renew)


def _renew(arguments: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(arguments.operator)
    member = known(arguments.node, desk, operator).member(arguments.name, desk.wall(), has_expired=True)
    # The grant must be later than the operator's last one.
    begin = max(int(desk.wall()), member.since + 1)
    tell(arguments.node, desk, operator.grant(member.public, member.name, member.roles, begin, arguments.life))
    end = begin + int(arguments.life)
    renews = arguments.life >= YEAR
    how = "bootstrap nodes renew it automatically" if renews else "it is not renewed automatically"
    return {"name": member.name, "roles": list(member.roles), "until": end, "renews": renews}, [
        f"{member.name} has a certificate until {day(end)}; {how}"
    ]
