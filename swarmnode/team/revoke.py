"""``swarm revoke``: revoke a member, or an invitation with all members that joined by it."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence

from middleware.admission.certificate import Member
from swarmnode.control_client import Rejection
from swarmnode.team.common import (
    Answer,
    CommandContext,
    VerifiedTeam,
    fetch_team,
    load_operator,
    make_parser,
    publish_statement,
    run_verb,
)


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Revoke a member, or an invitation with all members that joined by it."
    revoke = make_parser("revoke", purpose, example="dog1")
    revoke.add_argument("name", metavar="NAME", help="name of a member or an invitation, or its key in hexadecimal")
    revoke.add_argument("--invitation", action="store_true", help="revoke the invitation of that name, not the member")
    revoke.add_argument(
        "--all", action="store_true", help="also revoke all members that this bootstrap node admitted or renewed"
    )
    return run_verb(revoke, words, context, _revoke)


def _revoke(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    operator = load_operator(arguments.operator)
    found = fetch_team(arguments.node, context, operator)
    public, what, came = _resolve(found, arguments.name, arguments.invitation, context.wall())
    kept = [] if arguments.all else _list_admitted(found, public, context.wall())
    renewals = [] if arguments.all else _list_renewed(found, public, context.wall())
    try:
        keys = [each.public for each in kept]
        statement = operator.revoke(public, arguments.name[:40], context.wall(), keys, renewals)
    except ValueError as error:
        raise Rejection(f"{error}; pass --all, and invite again the members that should stay") from error
    publish_statement(arguments.node, context, statement)
    lines = [f"revoked {what} {arguments.name}; effective at all reachable nodes within 10 seconds"]
    lines += [f"  also revoked: {name}" for name in came]
    lines += [f"  stays a member, although admitted by {arguments.name}: {each.name}" for each in kept]
    lines.append("It still knows the team's secret; to replace the secret: swarm rotate")
    kept_names = [each.name for each in kept]
    return {"revoked": public.hex(), "what": what, "with": came, "kept": kept_names}, lines


def _list_admitted(found: VerifiedTeam, public: bytes, now: float) -> list[Member]:
    """Return the members that the bootstrap node ``public`` admitted."""
    return [each for each in found.list_members(now) if each.admitter == public]


def _list_renewed(found: VerifiedTeam, public: bytes, now: float) -> list[tuple[bytes, int]]:
    """Return the key and expiry of each renewal of current members that the bootstrap node ``public`` signed."""
    return [(each.public, each.not_after) for each in found.list_members(now) if each.renewer == public != each.public]


def _resolve(found: VerifiedTeam, name: str, is_invitation: bool, now: float) -> tuple[bytes, str, list[str]]:
    """Return the key for ``name``, its kind, and the members revoked with it; raises ``Rejection``."""
    invites = [each for each in found.membership_list.list_invitations() if name in (each.name, each.public.hex())]
    invites = [each for each in invites if found.membership_list.find_revocation(each.public) is None]
    try:
        if is_invitation:
            raise Rejection(f"no invitation has the name {name!r}; see swarm invitations")
        return found.find_member(name, now, has_expired=True).public, "the member", []
    except Rejection:
        if not invites and re.fullmatch(r"[0-9a-f]{64}", name):
            return bytes.fromhex(name), "the key", []  # a key can be revoked even if no list contains it
        if not invites:
            raise
    if len(invites) > 1:
        keys = ", ".join(each.public.hex() for each in invites)
        raise Rejection(f"several invitations have the name {name}; use the key instead: {keys}")
    came = [
        each.member.name
        for each in found.membership_list.list_admissions()
        if each.member.invitation == invites[0].public
    ]
    return invites[0].public, "the invitation", came
