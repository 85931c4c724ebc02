"""Revoke: ``swarm revoke``, which puts a member out of the team, or ends an invitation and puts out who came by it."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence

from middleware.admission.certificate import Member
from swarmnode.asker import Refusal
from swarmnode.team.office import Answer, Desk, Known, known, operator_in, options, run, tell


def main(words: Sequence[str] | None = None, desk: Desk | None = None) -> int:
    """Run the command; returns its exit code."""
    revoke = options("revoke", "Put a member out of the team, or end an invitation and put out all that came by it.")
    revoke.add_argument("name", metavar="NAME", help="of a member, or of an invitation; or its key in hexadecimal")
    revoke.add_argument("--invitation", action="store_true", help="the invitation of that name, not the member")
    revoke.add_argument("--all", action="store_true", help="a bootstrap node: with all that it let in or renewed")
    return run(revoke, words, desk, _revoked)


def _revoked(wishes: argparse.Namespace, desk: Desk) -> Answer:
    operator = operator_in(wishes.operator)
    found = known(wishes.node, desk, operator)
    public, what, came = _meant(found, wishes.name, wishes.invitation, desk.wall())
    kept = [] if wishes.all else _admitted_by(found, public, desk.wall())
    renewals = [] if wishes.all else _renewed_by(found, public, desk.wall())
    try:
        keys = [each.public for each in kept]
        statement = operator.revoke(public, wishes.name[:40], desk.wall(), keys, renewals)
    except ValueError as error:
        raise Refusal(f"{error}; say --all, and invite those that are to stay anew") from error
    tell(wishes.node, desk, statement)
    lines = [f"{what} {wishes.name} is revoked; in force at all that can be reached within 10 seconds"]
    lines += [f"  with it: {name}" for name in came]
    lines += [f"  stays, though {wishes.name} let it in: {each.name}" for each in kept]
    lines.append("What it knew stays known to it: give the team a new secret by swarm rotate")
    kept_names = [each.name for each in kept]
    return {"revoked": public.hex(), "what": what, "with": came, "kept": kept_names}, lines


def _admitted_by(found: Known, public: bytes, now: float) -> list[Member]:
    """Return the present members that the bootstrap node ``public`` let in."""
    return [each for each in found.members(now) if each.admitter == public]


def _renewed_by(found: Known, public: bytes, now: float) -> list[tuple[bytes, int]]:
    """Return the renewals of present members that the bootstrap node ``public`` signed: their keys and their ends."""
    return [(each.public, each.not_after) for each in found.members(now) if each.renewer == public != each.public]


def _meant(found: Known, name: str, is_invitation: bool, now: float) -> tuple[bytes, str, list[str]]:
    """The key that is meant, what it is, and who goes with it; raises ``Refusal``."""
    invites = [each for each in found.roll.invites() if name in (each.name, each.public.hex())]
    invites = [each for each in invites if found.roll.revoked(each.public) is None]
    try:
        if is_invitation:
            raise Refusal(f"no invitation is called {name!r}")
        return found.member(name, now, has_expired=True).public, "the member", []
    except Refusal:
        if not invites and re.fullmatch(r"[0-9a-f]{64}", name):
            return bytes.fromhex(name), "the key", []  # also of one that is on no list
        if not invites:
            raise
    if len(invites) > 1:
        keys = ", ".join(each.public.hex() for each in invites)
        raise Refusal(f"several invitations are called {name}; say which by its key: {keys}")
    came = [each.member.name for each in found.roll.admissions() if each.member.invitation == invites[0].public]
    return invites[0].public, "the invitation", came
