"""``swarm revoke``: revoke a member, or an invitation with all members that joined by it."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence

from middleware.admission.certificate import Member
from swarmnode.asker import Refusal
from swarmnode.team.office import Answer, Desk, Known, known, operator_in, options, run, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    purpose = "Revoke a member, or an invitation with all members that joined by it."
    revoke = options("revoke", purpose, example="dog1")
    revoke.add_argument("name", metavar="NAME", help="name of a member or an invitation, or its key in hexadecimal")
    revoke.add_argument("--invitation", action="store_true", help="revoke the invitation of that name, not the member")
    revoke.add_argument("--all", action="store_true", help="also revoke all that a bootstrap node admitted or renewed")
    return run(revoke, words, desk, _revoke)


def _revoke(arguments: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(arguments.operator)
    found = known(arguments.node, desk, operator)
    public, what, came = _resolve(found, arguments.name, arguments.invitation, desk.wall())
    kept = [] if arguments.all else _list_admitted(found, public, desk.wall())
    renewals = [] if arguments.all else _list_renewed(found, public, desk.wall())
    try:
        keys = [each.public for each in kept]
        statement = operator.revoke(public, arguments.name[:40], desk.wall(), keys, renewals)
    except ValueError as error:
        raise Refusal(f"{error}; pass --all, and invite the members again that are to stay") from error
    tell(arguments.node, desk, statement)
    lines = [f"revoked {what} {arguments.name}; effective at all reachable nodes within 10 seconds"]
    lines += [f"  also revoked: {name}" for name in came]
    lines += [f"  stays a member, although admitted by {arguments.name}: {each.name}" for each in kept]
    lines.append("It still knows the team's secret; replace that by: swarm rotate")
    kept_names = [each.name for each in kept]
    return {"revoked": public.hex(), "what": what, "with": came, "kept": kept_names}, lines


def _list_admitted(found: Known, public: bytes, now: float) -> list[Member]:
    """Return the members that the bootstrap node ``public`` admitted."""
    return [each for each in found.members(now) if each.admitter == public]


def _list_renewed(found: Known, public: bytes, now: float) -> list[tuple[bytes, int]]:
    """Return the key and end of each renewal of current members that the bootstrap node ``public`` signed."""
    return [(each.public, each.not_after) for each in found.members(now) if each.renewer == public != each.public]


def _resolve(found: Known, name: str, is_invitation: bool, now: float) -> tuple[bytes, str, list[str]]:
    """Return the key for ``name``, its kind, and the members revoked with it; raises ``Refusal``."""
    invites = [each for each in found.roll.invites() if name in (each.name, each.public.hex())]
    invites = [each for each in invites if found.roll.revoked(each.public) is None]
    try:
        if is_invitation:
            raise Refusal(f"no invitation has the name {name!r}; see swarm invitations")
        return found.member(name, now, has_expired=True).public, "the member", []
    except Refusal:
        if not invites and re.fullmatch(r"[0-9a-f]{64}", name):
            return bytes.fromhex(name), "the key", []  # also a key that is on no list
        if not invites:
            raise
    if len(invites) > 1:
        keys = ", ".join(each.public.hex() for each in invites)
        raise Refusal(f"several invitations have the name {name}; use the key instead: {keys}")
    came = [each.member.name for each in found.roll.admissions() if each.member.invitation == invites[0].public]
    return invites[0].public, "the invitation", came
