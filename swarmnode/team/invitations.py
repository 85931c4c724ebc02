"""``swarm invitations``: list the operator's invitations, and the members that joined by each."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from middleware.admission.statement import Invite
from swarmnode.team.common import Answer, CommandContext, VerifiedTeam, fetch_team, format_time, make_parser, run_verb

OPEN, USED, EXPIRED, REVOKED = "open", "used", "expired", "revoked"


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "List the invitations that can still be used; to end an invitation, use swarm revoke."
    invitations = make_parser("invitations", purpose, needs_key=False, example="--all")
    invitations.add_argument("--all", action="store_true", help="also list used, expired and revoked invitations")
    return run_verb(invitations, words, context, _list)


def _list(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    now = context.wall()
    found = fetch_team(arguments.node, context)
    rows = [_make_row(found, each, now) for each in found.membership_list.list_invitations()]
    rows = [row for row in rows if arguments.all or row["state"] == OPEN]
    width = max((len(row["name"]) for row in rows), default=0)
    lines = []
    for row in rows:
        until = format_time(row["until"], has_time=True)
        line = f"{row['name']:{width}}  {', '.join(row['roles'])}  {row['left']} of {row['uses']} left"
        came = f"  joined: {', '.join(row['came'])}" if row["came"] else ""
        lines.append(f"{line}  until {until}  {row['state']}{came}")
    end = "To end an invitation: swarm revoke NAME --invitation"
    return {"team": found.team, "invitations": rows}, [*lines, end] if lines else ["no open invitations"]


def _make_row(found: VerifiedTeam, invite: Invite, now: float) -> dict[str, Any]:
    """Return the invitation as plain data."""
    came = [
        each.member.name for each in found.membership_list.list_admissions() if each.member.invitation == invite.public
    ]
    left = max(0, invite.uses - len(came))
    state = OPEN if left else USED
    if invite.not_after <= now:
        state = EXPIRED
    if found.membership_list.find_revocation(invite.public) is not None:
        state = REVOKED
    about = {"name": invite.name, "roles": list(invite.roles), "uses": invite.uses, "left": left}
    return about | {"until": invite.not_after, "state": state, "came": came, "key": invite.public.hex()}
