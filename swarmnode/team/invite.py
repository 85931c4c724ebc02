"""``swarm invite``: create a join code, as text and as a QR code."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence

from middleware.admission.statement import DEFAULT_LIFE_S, MAX_USES, ROLES
from swarmnode.control_client import Rejection
from swarmnode.team.common import (
    Answer,
    CommandContext,
    InvalidCommand,
    fetch_team,
    format_duration,
    load_operator,
    make_parser,
    parse_duration,
    publish_statement,
    run_verb,
)

DAY_S = 86_400.0
INVITABLE_ROLES = tuple(role for role in ROLES if role != "bootstrap")


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    invite = make_parser("invite", "Create a code with which a newcomer joins the team.", example="dog1 --expires 24h")
    invite.add_argument("name", metavar="NAME", help="name of the newcomer")
    invite.add_argument(
        "--role", choices=INVITABLE_ROLES, action="append", help="role; can be repeated (default: device)"
    )
    invite.add_argument("--uses", type=int, default=1, metavar="N", help=f"number of newcomers, 1 to {MAX_USES}")
    invite.add_argument(
        "--expires",
        type=parse_duration,
        default=DAY_S,
        metavar="TIME",
        help="validity of the code, such as 10m (default: 24h)",
    )
    invite.add_argument(
        "--for",
        dest="life",
        type=parse_duration,
        default=float(DEFAULT_LIFE_S),
        metavar="TIME",
        help="validity of the certificate (default: 365d); a year or more is renewed automatically",
    )
    return run_verb(invite, words, context, _invite)


def _invite(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    operator = load_operator(arguments.operator)
    roles = arguments.role or ["device"]
    try:
        code, statement, terms = operator.invite(
            arguments.name, roles, arguments.uses, context.wall(), arguments.expires, context.rng, arguments.life
        )
    except ValueError as error:
        raise InvalidCommand(
            f"{error}: a name has 1 to 40 letters, digits, _ or -, and a code 1 to {MAX_USES} uses"
        ) from error
    found = fetch_team(arguments.node, context, operator)
    if arguments.uses == 1 and arguments.name in {each.name for each in found.list_members(context.wall())}:
        raise Rejection(
            f"the team already has a member {arguments.name}; choose another name, or revoke that member first"
        )
    addresses = found.bootstrap_addresses
    publish_statement(arguments.node, context, terms)
    publish_statement(arguments.node, context, statement)
    text = f"{code.text}@{','.join(addresses)}" if addresses else code.text
    answer = {"code": code.text, "at": list(addresses), "text": text, "name": arguments.name, "roles": list(roles)}
    times = "once" if arguments.uses == 1 else f"{arguments.uses} times"
    lines = [f"{code.text}   admits {arguments.name}, {times}, within {format_duration(arguments.expires)}"]
    lines.append(f"On the newcomer:  swarm join {text}")
    if not addresses:
        lines.append("No bootstrap node is reachable now; pass the address of one: swarm join CODE --at HOST:PORT")
    return answer, [*lines, *render_qr_code(text)]


def render_qr_code(text: str) -> list[str]:
    """Return a QR code of ``text`` as lines of characters, or a hint if the library segno is missing."""
    try:
        import segno
    except ModuleNotFoundError:
        return ["(to show a QR code, install segno: pip install 'swarm-node[web]')"]
    drawing = io.StringIO()
    segno.make(text, micro=False, error="m", boost_error=False).terminal(drawing, compact=True)
    return ["", *drawing.getvalue().splitlines()]
