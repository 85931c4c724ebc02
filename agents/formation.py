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
from agents.exploration import Pose, is_blocked, turn_to, walk_to
from agents.means import Means
from drivers.reading import Action
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


LONGEST = 0.45
"""Metres of a chord: three seconds' walk of an ERS-7, in which the target is out of sight."""
NEAREST = 0.45
"""Who stands nearer to the target than this stays: it would be in the way."""


class Circling:
    """One robot's way to its post around the target, at the distance that it has, in legs that its ranger looks along.

    A robot sees and ranges only ahead, and one without a ranger stays where it is.  So it turns along the circle, walks
    a short chord while the way is open, and turns back to look at the target before the next one.
    """

    def __init__(self, means: Means | None = None) -> None:
        self.means = Means() if means is None else means
        self._post: float | None = None
        self._is_blocked = False
        self._heading: float | None = None
        self._leg = 0.0
        self._leg_from: tuple[float, float] | None = None

    def send(self, post: float | None) -> None:
        """Go to ``post`` (radians as seen from the target, by the compass; None: stay)."""
        if post is None or self._post is None or abs(math.remainder(post - self._post, math.tau)) > CLOSE:
            self._post, self._is_blocked = post, False

    @property
    def is_walking(self) -> bool:
        """Whether the robot looks where it walks, and not at the target."""
        return self._heading is not None

    def step(
        self, pose: Pose, target: tuple[float, float], angle: float | None, ahead: float, is_facing: bool
    ) -> Action | None:
        """What to do next on the way; None where the robot is to stand and look at the target.

        ``pose`` and ``target`` are in the robot's odometry, ``angle`` is where it stands as seen from the target,
        ``ahead`` the range ahead, ``is_facing`` whether the target is before its eyes.
        """
        if self._heading is None and not self._begins(pose, target, angle, is_facing):
            return None
        assert self._heading is not None
        off = math.remainder(self._heading - pose[2], math.tau)
        if self._leg_from is None:
            if (turn := turn_to(self.means, off)) is not None:
                return turn
            self._leg_from = pose[:2]
        if is_blocked(ahead):
            self._is_blocked = True  # a wall, or another robot: this is as near to the post as can be
            return self.rest()
        if math.dist(self._leg_from, pose[:2]) >= self._leg:
            return self.rest()
        return walk_to(self.means, off)

    def rest(self) -> Action | None:
        """End the leg; the target is looked at next."""
        self._heading = self._leg_from = None
        return None

    def _begins(self, pose: Pose, target: tuple[float, float], angle: float | None, is_facing: bool) -> bool:
        """Whether a leg begins here, and which."""
        if self._post is None or angle is None or self._is_blocked or not is_facing or not self.means.ranges:
            return False
        way = math.remainder(self._post - angle, math.tau)
        radius = math.dist(pose[:2], target)
        if abs(way) <= CLOSE or radius < NEAREST:
            return False
        outward = math.atan2(pose[1] - target[1], pose[0] - target[0])
        # A chord leans inwards by half the angle that it spans: so the distance stays.
        half = min(abs(way) / 2, math.asin(LONGEST / 2 / radius))
        self._leg = 2 * radius * math.sin(half)
        self._heading = outward + math.copysign(math.pi / 2 + half, way)
        return True
