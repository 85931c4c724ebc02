"""Assign posts to the robots that do not act, for the best joint view (thesis, section 4.2.5); pure.

A post is the place of one robot around the target. All robots have the target and compass north in common: from its
compass and the bearing of the target each robot computes its own direction as seen from the target. The posts are
evenly spaced around the target, in the robots' current order, so that no paths cross; the assigned robot does not move.
Until the target is seen, each robot searches its own sector. The formation changes only after a member has left, to
close the gap.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from agents.behaviour import Behaviour
from agents.exploration import Pose, is_blocked, turn_to, walk_to
from agents.motion import MotionCapabilities
from drivers.reading import Action
from middleware.tasks.task import Member

POST_TOLERANCE_RAD = math.radians(20.0)
"""A robot within this angle of its post has arrived."""


@dataclass(frozen=True)
class Post:
    """The direction of a robot's post as seen from the target (``angle``; None: anywhere), and the sector to search.

    ``sector`` is the middle and the width of the sector; all angles are in radians by the compass.
    """

    angle: float | None
    sector: tuple[float, float]


def assign_posts(angles: Sequence[tuple[str, float]], assigned: str | None) -> dict[str, float]:
    """Return the post of each robot in ``angles`` (robot uuid to its direction as seen from the target).

    The ``assigned`` robot keeps its direction; if no robot is assigned, the posts are rotated so that the paths are
    short overall.
    """
    order = sorted(angles, key=lambda one: (one[1] % math.tau, one[0]))
    step = math.tau / max(1, len(order))
    fixed = next((n for n, (uuid, _) in enumerate(order) if uuid == assigned), None)
    if fixed is None:
        # The rotations that would put each robot's post at its present direction; with their circular mean the robots
        # move least in total.
        preferred_turns = [angle - n * step for n, (_, angle) in enumerate(order)]
        turn = math.atan2(sum(map(math.sin, preferred_turns)), sum(map(math.cos, preferred_turns)))
    else:
        turn = order[fixed][1] - fixed * step
    return {uuid: math.remainder(turn + n * step, math.tau) for n, (uuid, _) in enumerate(order)}


def assign_sector(uuid: str, present: Collection[str]) -> tuple[float, float]:
    """Return the sector of ``uuid``: the present robots share the full circle evenly, sorted by uuid."""
    width = math.tau / len(present)
    return math.remainder(width * (sorted(present).index(uuid) + 0.5), math.tau), width


class Formation:
    """The formation at one task as computed by the robot ``uuid`` with ``behaviour``."""

    def __init__(self, uuid: str, behaviour: Behaviour) -> None:
        self.has_gap = False
        """Whether a member has left, so that there is a gap to close."""
        self._uuid = uuid
        self._take_post = getattr(behaviour, "take_post", None)
        self._present: set[str] = set()
        self._post: float | None = None

    def update_members(self, members: Sequence[Member]) -> list[str]:
        """Process the other present members; return the uuids of the departed ones."""
        present = {member.uuid for member in members}
        left, self._present = sorted(self._present - present), present
        self.has_gap = self.has_gap or bool(left)
        return left if self._take_post is not None else []

    def assign_post(self, me: Member, others: Sequence[Member], assigned: str | None) -> float | None:
        """Send the robot to its post and return the angle; None if it has no post, like the ``assigned`` robot."""
        if self._take_post is None or not self.has_gap:
            return None
        available_members = [member for member in (me, *others) if member.available]
        angles = [(member.uuid, member.angle) for member in available_members if member.angle is not None]
        placed = assign_posts(angles, assigned)
        angle = placed.get(self._uuid) if len(angles) > 1 and self._uuid != assigned else None
        if (
            angle is not None
            and self._post is not None
            and abs(math.remainder(angle - self._post, math.tau)) <= POST_TOLERANCE_RAD
        ):
            angle = self._post  # other robots report their angles rarely: small changes do not move the post
        self._post = None if angle is None else round(angle, 2)
        self._take_post(Post(self._post, assign_sector(self._uuid, {member.uuid for member in (me, *others)})))
        return self._post


MAX_CHORD_M = 0.45
"""Maximum metres of a chord: an ERS-7 walks this distance in three seconds, without seeing the target."""
MIN_CIRCLING_RADIUS_M = 0.45
"""Metres from the target within which a robot does not move, so that it does not obstruct the acting robot."""


class PostPath:
    """The path of one robot to its post around the target at constant distance, in short chords.

    Camera and ranger of a robot look only ahead, so the robot turns along the circle and walks a chord while the path
    is free. Before the next chord it turns back to the target. A robot without a ranger does not move.
    """

    def __init__(self, motion: MotionCapabilities | None = None) -> None:
        self.motion = MotionCapabilities() if motion is None else motion
        self._post: float | None = None
        self._is_blocked = False
        self._heading: float | None = None
        self._leg_m = 0.0
        self._leg_from: tuple[float, float] | None = None

    def set_post(self, post: float | None) -> None:
        """Set the post (radians as seen from the target, by the compass; None: stay)."""
        if post is None or self._post is None or abs(math.remainder(post - self._post, math.tau)) > POST_TOLERANCE_RAD:
            self._post, self._is_blocked = post, False

    @property
    def is_walking(self) -> bool:
        """Whether the robot faces its path instead of the target."""
        return self._heading is not None

    def step(
        self, pose: Pose, target: tuple[float, float], angle: float | None, ahead: float, is_facing: bool
    ) -> Action | None:
        """Return the next action; None if the robot should stand and face the target.

        ``pose`` and ``target`` are in the robot's odometry, ``angle`` is the robot's direction as seen from the target,
        ``ahead`` the range ahead, and ``is_facing`` whether the camera faces the target.
        """
        if self._heading is None and not self._start_leg(pose, target, angle, is_facing):
            return None
        assert self._heading is not None
        off = math.remainder(self._heading - pose[2], math.tau)
        if self._leg_from is None:
            if (turn := turn_to(self.motion, off)) is not None:
                return turn
            self._leg_from = pose[:2]
        if is_blocked(ahead):
            self._is_blocked = True  # a wall or another robot: the robot is as near to the post as possible
            return self.end_leg()
        if math.dist(self._leg_from, pose[:2]) >= self._leg_m:
            return self.end_leg()
        return walk_to(self.motion, off)

    def end_leg(self) -> Action | None:
        """End the leg; the robot faces the target next."""
        self._heading = self._leg_from = None
        return None

    def _start_leg(self, pose: Pose, target: tuple[float, float], angle: float | None, is_facing: bool) -> bool:
        """Start a leg if one is due, and return whether it was started."""
        if self._post is None or angle is None or self._is_blocked or not is_facing or not self.motion.ranges:
            return False
        arc = math.remainder(self._post - angle, math.tau)
        radius = math.dist(pose[:2], target)
        if abs(arc) <= POST_TOLERANCE_RAD or radius < MIN_CIRCLING_RADIUS_M:
            return False
        outward = math.atan2(pose[1] - target[1], pose[0] - target[0])
        # The heading of a chord points inwards by half of the arc, so that the distance to the target is the same at
        # its end.
        half = min(abs(arc) / 2, math.asin(MAX_CHORD_M / 2 / radius))
        self._leg_m = 2 * radius * math.sin(half)
        self._heading = outward + math.copysign(math.pi / 2 + half, arc)
        return True
