"""Renew: ``swarm renew``, a new certificate for the key of a member, also of one that has expired."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from middleware.admission.statement import YEAR
from swarmnode.team.office import Answer, Desk, day, known, operator_in, options, run, seconds, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    renew = options("renew", "Certify a member anew, with its key, name and roles; also one that has expired.")
    renew.add_argument("name", metavar="NAME", help="of the member; or its key in hexadecimal")
    renew.add_argument(
        "--for", dest="life", type=seconds, default=float(YEAR), metavar="TIME", help="for how long from now on (365d)"
    )
    return run(renew, words, desk, _renewed)


def _renewed(wishes: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(wishes.operator)
    member = known(wishes.node, desk, operator).member(wishes.name, desk.wall(), has_expired=True)
    # Later than the operator's last word about that key, or it would not hold.
    begin = max(int(desk.wall()), member.since + 1)
    tell(wishes.node, desk, operator.grant(member.public, member.name, member.roles, begin, wishes.life))
    end = begin + int(wishes.life)
    renews = wishes.life >= YEAR
    how = "bootstrap nodes renew it from then on" if renews else "and ends then"
    return {"name": member.name, "roles": list(member.roles), "until": end, "renews": renews}, [
        f"{member.name} is certified until {day(end)}; {how}"
    ]
