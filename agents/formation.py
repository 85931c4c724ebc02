"""Formation: where those who do not act stand and look, so that together they see most (thesis, section 4.2.5); pure.

What all robots share is the target, and north: by the compass and the bearing of the target each knows in which
direction it stands as seen from the target.  Around it the posts lie evenly, in the order in which the robots stand
already, so that no way crosses another's; who is to act stays where it is.  Before the target is seen each looks into a
sector of its own.  As long as nobody has left all this rests: the formation closes the gap of a member that is gone.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from agents.behaviour import Behaviour
from middleware.tasks.task import Member

CLOSE = math.radians(20.0)
"""A robot that stands no farther than this from its post is there."""


@dataclass(frozen=True)
class Post:
    """Where a robot is to stand as seen from the target (None: anywhere), and the sector that it is to search.

    ``sector`` is its middle and its width; all in radians by the compass.
    """

    angle: float | None
    sector: tuple[float, float]


def posts(angles: Sequence[tuple[str, float]], assigned: str | None) -> dict[str, float]:
    """The post of each robot of ``angles`` (its uuid, and where it stands as seen from the target).

    Who is ``assigned`` keeps its place; where nobody is, the ways are as short as can be on the whole.
    """
    order = sorted(angles, key=lambda one: (one[1] % math.tau, one[0]))
    step = math.tau / max(1, len(order))
    fixed = next((n for n, (uuid, _) in enumerate(order) if uuid == assigned), None)
    if fixed is None:
        # Each says where the first post would have to lie for it to stay; their mean moves all together the least.
        wishes = [angle - n * step for n, (_, angle) in enumerate(order)]
        turn = math.atan2(sum(map(math.sin, wishes)), sum(map(math.cos, wishes)))
    else:
        turn = order[fixed][1] - fixed * step
    return {uuid: math.remainder(turn + n * step, math.tau) for n, (uuid, _) in enumerate(order)}


def sector(uuid: str, present: Collection[str]) -> tuple[float, float]:
    """The sector of ``uuid`` among those present, who share the circle evenly in the order of their uuids."""
    width = math.tau / len(present)
    return math.remainder(width * (sorted(present).index(uuid) + 0.5), math.tau), width


class Formation:
    """The formation at one task, as the robot ``uuid`` with ``behaviour`` takes part in it."""

    def __init__(self, uuid: str, behaviour: Behaviour) -> None:
        self.is_open = False
        """Whether a member has left, so that there is a gap to be closed."""
        self._uuid = uuid
        self._take_post = getattr(behaviour, "take_post", None)
        self._present: set[str] = set()
        self._post: float | None = None

    def hear(self, members: Sequence[Member]) -> list[str]:
        """Take in who is present beside this robot; the uuids of those that have left since."""
        present = {member.uuid for member in members}
        left, self._present = sorted(self._present - present), present
        self.is_open = self.is_open or bool(left)
        return left if self._take_post is not None else []

    def close_up(self, me: Member, others: Sequence[Member], assigned: str | None) -> float | None:
        """Send the robot to its post, where there is one; its angle.  Who is ``assigned`` has none: it is to act."""
        if self._take_post is None or not self.is_open:
            return None
        here = [member for member in (me, *others) if member.available]
        angles = [(member.uuid, member.angle) for member in here if member.angle is not None]
        placed = posts(angles, assigned)
        angle = placed.get(self._uuid) if len(angles) > 1 and self._uuid != assigned else None
        if angle is not None and self._post is not None and abs(math.remainder(angle - self._post, math.tau)) <= CLOSE:
            angle = self._post  # the others' angles are told with gaps: a post does not follow every word
        self._post = None if angle is None else round(angle, 2)
        self._take_post(Post(self._post, sector(self._uuid, {member.uuid for member in (me, *others)})))
        return self._post
