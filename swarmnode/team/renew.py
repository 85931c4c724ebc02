"""Renew: ``swarm renew``, a new certificate for the key of a member, also of one that has expired."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from middleware.admission.statement import YEAR
from swarmnode.team.office import Desk, known, operator_in, options, run, seconds, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    desk = desk or Desk()
    renew = options("renew", "Certify a member anew, with its key, name and roles; also one that has expired.")
    renew.add_argument("name", metavar="NAME", help="of the member; or its key in hexadecimal")
    renew.add_argument(
        "--for", dest="life", type=seconds, default=float(YEAR), metavar="TIME", help="for how long from now on (365d)"
    )
    wishes = renew.parse_args(words)

    def work() -> tuple[Any, list[str]]:
        operator = operator_in(wishes.operator)
        member = known(wishes.node, desk, operator).member(wishes.name, desk.wall(), has_expired=True)
        # Later than the operator's last word about that key, or it would not hold.
        begin = max(int(desk.wall()), member.since + 1)
        tell(wishes.node, desk, operator.grant(member.public, member.name, member.roles, begin, wishes.life))
        end = begin + int(wishes.life)
        renews = wishes.life >= YEAR
        how = "bootstrap nodes renew it from then on" if renews else "and ends then"
        day = time.strftime("%Y-%m-%d", time.gmtime(end))
        return {"name": member.name, "roles": list(member.roles), "until": end, "renews": renews}, [
            f"{member.name} is certified until {day}; {how}"
        ]

    return run("renew", work, wishes.json, desk.out)
