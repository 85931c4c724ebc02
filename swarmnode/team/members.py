"""``swarm members``: list the members of the team with the ends of their certificates, and open invitations."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from middleware.entangled.network.url import VIRTUAL_PREFIX
from swarmnode.team.common import Answer, CommandContext, fetch_team, format_time, make_parser, run_verb


def main(words: Sequence[str] | None = None, context: CommandContext | None = None) -> int:
    """Run the command; returns its exit code."""
    members = make_parser("members", "List the members of the team.", needs_key=False, example="--json")
    return run_verb(members, words, context, _list)


def _list(arguments: argparse.Namespace, context: CommandContext) -> Answer:
    now = context.wall()
    found = fetch_team(arguments.node, context)
    rows: list[dict[str, Any]] = [
        {
            "name": each.name,
            "roles": list(each.roles),
            "until": each.not_after,
            "renews": each.is_renewable,
            "at": found.addresses.get(each.public, ""),
            "key": each.public.hex(),
        }
        for each in found.list_members(now)
    ]
    expired: list[dict[str, Any]] = [
        {"name": each.name, "roles": list(each.roles), "until": each.not_after, "key": each.public.hex()}
        for each in found.list_expired(now)
    ]
    used = [each.member.invitation for each in found.membership_list.list_admissions()]
    open_: list[dict[str, Any]] = [
        {"name": each.name, "roles": list(each.roles), "left": each.uses - used.count(each.public)}
        | {"until": each.not_after, "key": each.public.hex()}
        for each in found.membership_list.list_invitations()
        if now < each.not_after and found.membership_list.find_revocation(each.public) is None
        if used.count(each.public) < each.uses
    ]
    revoked = [
        {"name": each.name, "at": each.at, "key": each.public.hex()}
        for each in found.membership_list.list_revocations()
    ]
    width = max((len(row["name"]) for row in [*rows, *expired, *open_]), default=0)
    lines = [f"team {found.team}, secret number {found.secret_number}"]
    for row in rows:
        until = format_time(row["until"])
        location = format_location(row["at"])
        renewal = "renewed automatically" if row["renews"] else "not renewed"
        lines.append(f"  {row['name']:{width}}  {', '.join(row['roles'])}  until {until}, {renewal}  {location}")
    for row in expired:
        until = format_time(row["until"])
        lines.append(f"  {row['name']:{width}}  expired {until}; to readmit it: swarm renew {row['name']}")
    for row in open_:
        until = format_time(row["until"], has_time=True)
        lines.append(f"  {row['name']:{width}}  invited, {row['left']} left, until {until}")
    lines += [f"  {row['name']:{width}}  revoked" for row in revoked]
    about = {"members": rows, "expired": expired, "invitations": open_, "revoked": revoked}
    return {"team": found.team, **about}, lines


def format_location(address: str) -> str:
    """Return a member's location as text; virtual addresses are meaningful to this node only."""
    if not address.startswith("~"):
        return address or "no known address"
    return "by a tunnel" if address.startswith(VIRTUAL_PREFIX) else "by a relay"
