"""Vacancy: a seat of a council whose member is gone, and who takes it; pure."""

from __future__ import annotations

from collections.abc import Sequence

from middleware.entangled.contact import Contact
from middleware.entangled.quorum.ballot import majority


def filled(
    members: Sequence[Contact], silent: Sequence[Contact], candidates: Sequence[Contact], size: int
) -> tuple[Contact, ...] | None:
    """The council that should follow that of ``members``, of whom some are ``silent``; None where it may stay.

    Who is there stays; ``candidates`` take the other seats in their order, up to ``size``.  A council changes only
    where more of those that are there could be lost after than before: three for two, but never four for three.
    """
    gone, seated = {member.node_id for member in silent}, {member.node_id for member in members}
    here = [member for member in members if member.node_id not in gone]
    others = [one for one in candidates if one.node_id not in seated]
    following = (*here, *others)[: max(size, len(here))]
    following = odd(following)
    if _spare(len(following), len(following)) <= _spare(len(here), len(members)):
        return None
    return following


def odd(members: Sequence[Contact]) -> tuple[Contact, ...]:
    """So many of the first ``members`` that their number is odd: of four no more may be lost than of three."""
    return tuple(members[: len(members) - 1 + len(members) % 2])


def _spare(here: int, size: int) -> int:
    """How many of those that are ``here`` may be lost before no majority of ``size`` is left."""
    return here - majority(size)
