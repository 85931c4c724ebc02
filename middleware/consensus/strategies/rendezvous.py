"""Strategies that agree on a meeting place.

``rendezvous`` is the mean of the agents' positions, ``rendezvous_centre`` minimises the longest distance (1-centre) and
``rendezvous_median`` the sum of distances (Weiszfeld 1937).  Each meeting place is in the convex hull of the positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from middleware.consensus.strategies.average import Average, Point, mean

ITERATIONS = 200
"""Number of iterations of the median, and of the centre in three dimensions.  It is fixed, so that all machines get the
same result."""
SLACK = 1e-9


class Rendezvous(Average):
    """The mean of the agents' positions (``Report.value``)."""

    name = "rendezvous"


class Centre(Average):
    """The place with the smallest distance to the farthest agent; weights are ignored."""

    name = "rendezvous_centre"

    def combine_points(self, points: Sequence[Point], weights: Sequence[float]) -> Point:
        """Return the centre of the points, which may be in any order."""
        return centre(points)


class Median(Average):
    """The place with the smallest weighted sum of distances to all agents."""

    name = "rendezvous_median"

    def combine_points(self, points: Sequence[Point], weights: Sequence[float]) -> Point:
        """Return the median of the points, which may be in any order."""
        return median(points, weights)


def centre(points: Sequence[Point]) -> Point:
    """Return the centre of the smallest enclosing circle or sphere.

    In three dimensions, the error is at most 1 % of the radius.
    """
    places = sorted(set(points))
    if len(places) == 1:
        return places[0]
    if len(places[0]) == 1:
        return ((places[0][0] + places[-1][0]) / 2.0,)
    if len(places[0]) == 2:
        return _clamp(_smallest_circle(places)[0], places)
    estimate = mean(places, [1.0] * len(places))
    for step in range(1, ITERATIONS + 1):  # Badoiu and Clarkson 2003
        far = max(places, key=lambda p: math.dist(estimate, p))
        estimate = tuple(a + (b - a) / (step + 1) for a, b in zip(estimate, far, strict=True))
    return estimate


def median(points: Sequence[Point], weights: Sequence[float]) -> Point:
    """Return the weighted geometric median."""
    pairs = sorted(zip(points, weights, strict=True))
    places, shares = [p for p, _ in pairs], [w for _, w in pairs]
    best = min(places, key=lambda p: (_total_distance(p, places, shares), p))
    estimate = mean(places, shares)
    for _ in range(ITERATIONS):
        near = [w / max(math.dist(estimate, p), SLACK) for p, w in pairs]
        estimate = mean(places, near)
    # If the median is one of the points, the iterations converge slowly.
    return best if _total_distance(best, places, shares) <= _total_distance(estimate, places, shares) else estimate


def _total_distance(estimate: Point, places: Sequence[Point], weights: Sequence[float]) -> float:
    return math.fsum(w * math.dist(estimate, p) for p, w in zip(places, weights, strict=True))


def _smallest_circle(places: Sequence[Point]) -> tuple[Point, float]:
    """Return the smallest enclosing circle (Welzl 1991, in the given order of points instead of a random one)."""
    found = (places[0], 0.0)
    for i, p in enumerate(places):
        if not _contains(found, p):
            found = (p, 0.0)
            for j, q in enumerate(places[:i]):
                if not _contains(found, q):
                    found = _circumscribe(p, q)
                    for r in places[:j]:
                        if not _contains(found, r):
                            found = _circumscribe(p, q, r)
    return found


def _contains(circle: tuple[Point, float], place: Point) -> bool:
    return math.dist(circle[0], place) <= circle[1] * (1.0 + SLACK) + SLACK * SLACK


def _circumscribe(*places: Point) -> tuple[Point, float]:
    """Return the circle through three points, or the circle with the line between two points as its diameter.

    For three collinear points, the diameter is the line between the two points that are farthest apart.
    """
    if len(places) == 3:
        (ax, ay), (bx, by), (cx, cy) = places
        bx, by, cx, cy = bx - ax, by - ay, cx - ax, cy - ay
        twice = 2.0 * (bx * cy - by * cx)
        if abs(twice) > 1e-12 * (abs(bx) + abs(by) + abs(cx) + abs(cy)) ** 2:
            x = (cy * (bx * bx + by * by) - by * (cx * cx + cy * cy)) / twice
            y = (bx * (cx * cx + cy * cy) - cx * (bx * bx + by * by)) / twice
            return (ax + x, ay + y), math.hypot(x, y)
    p, q = max(combinations(places, 2), key=lambda pair: math.dist(*pair))
    return tuple((a + b) / 2.0 for a, b in zip(p, q, strict=True)), math.dist(p, q) / 2.0


def _clamp(place: Point, places: Sequence[Point]) -> Point:
    """Clamp ``place`` to the bounding box of the points, because rounding errors may move it outside."""
    sides = zip(place, zip(*places, strict=True), strict=True)
    return tuple(min(max(x, min(numbers)), max(numbers)) for x, numbers in sides)
