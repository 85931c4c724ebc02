"""Invite: ``swarm invite``, a short code that lets a newcomer in, as text and as a picture for a phone's camera."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence

from middleware.admission.statement import MAX_USES, ROLES, YEAR
from swarmnode.asker import Refusal
from swarmnode.team.office import Answer, Desk, Wrong, known, operator_in, options, run, seconds, span, tell

DAY = 86_400.0
INVITED = tuple(role for role in ROLES if role != "bootstrap")


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    invite = options("invite", "Make a code that lets a newcomer into the team.")
    invite.add_argument("name", metavar="NAME", help="what the newcomer is called")
    invite.add_argument("--role", choices=INVITED, action="append", help="what it may do; may be said again (device)")
    invite.add_argument("--uses", type=int, default=1, metavar="N", help=f"newcomers that may use it, 1 to {MAX_USES}")
    invite.add_argument("--expires", type=seconds, default=DAY, metavar="TIME", help="until when, as 10m or 24h (24h)")
    invite.add_argument(
        "--for",
        dest="life",
        type=seconds,
        default=float(YEAR),
        metavar="TIME",
        help="how long it is a member (365d); a year or more is renewed",
    )
    return run(invite, words, desk, _invited)


def _invited(wishes: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(wishes.operator)
    roles = wishes.role or ["device"]
    try:
        code, statement, terms = operator.invite(
            wishes.name, roles, wishes.uses, desk.wall(), wishes.expires, desk.rng, wishes.life
        )
    except ValueError as error:
        raise Wrong(f"{error}: a name has 1 to 40 letters, digits, _ or -, and a code 1 to {MAX_USES} uses") from error
    found = known(wishes.node, desk, operator)
    if wishes.uses == 1 and wishes.name in {each.name for each in found.members(desk.wall())}:
        raise Refusal(f"a member is called {wishes.name} already; choose another name, or revoke that one first")
    doors = found.doors
    tell(wishes.node, desk, terms)
    tell(wishes.node, desk, statement)
    whole = f"{code.text}@{','.join(doors)}" if doors else code.text
    answer = {"code": code.text, "at": list(doors), "text": whole, "name": wishes.name, "roles": list(roles)}
    times = "once" if wishes.uses == 1 else f"{wishes.uses} times"
    lines = [f"{code.text}   lets in {wishes.name}, {times}, within {span(wishes.expires)}"]
    lines.append(f"On the newcomer:  swarm join {whole}")
    if not doors:
        lines.append("No bootstrap node is in sight now; name one by: swarm join CODE --at HOST:PORT")
    return answer, [*lines, *picture(whole)]


def picture(text: str) -> list[str]:
    """A QR code of ``text`` in characters; a hint where there is no library to draw it with."""
    try:
        import segno
    except ModuleNotFoundError:
        return ["(a QR code is drawn where segno is installed: pip install 'swarm-node[web]')"]
    drawing = io.StringIO()
    segno.make(text, micro=False, error="m", boost_error=False).terminal(drawing, compact=True)
    return ["", *drawing.getvalue().splitlines()]
