"""Rendezvous: where to meet, out of where all are.

The mean of the places is easy to see; the centre makes the longest way as short as possible (1-centre), the median the
sum of the ways (Weiszfeld 1937).  Each lies within the convex hull of the places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from middleware.consensus.strategies.average import Average, Point, mean

STEPS = 200
"""Iterations of the median, and of the centre in space; each is the same on every machine."""
SLACK = 1e-9


class Rendezvous(Average):
    """The mean of the places of all (``Report.value``)."""

    name = "rendezvous"


class Centre(Average):
    """The place from which the farthest agent is nearest; weights do not count."""

    name = "rendezvous_centre"

    def point(self, points: Sequence[Point], weights: Sequence[float]) -> Point:
        """What is agreed on, for points in any order."""
        return centre(points)


class Median(Average):
    """The place to which all ways together are shortest, by weight."""

    name = "rendezvous_median"

    def point(self, points: Sequence[Point], weights: Sequence[float]) -> Point:
        """What is agreed on, for points in any order."""
        return median(points, weights)


def centre(points: Sequence[Point]) -> Point:
    """The centre of the smallest circle around all points; in other than two dimensions nearly (1 % of its radius)."""
    places = sorted(set(points))
    if len(places) == 1:
        return places[0]
    if len(places[0]) == 1:
        return ((places[0][0] + places[-1][0]) / 2.0,)
    if len(places[0]) == 2:
        return _in_hull(_circle(places)[0], places)
    here = mean(places, [1.0] * len(places))
    for step in range(1, STEPS + 1):  # Badoiu and Clarkson 2003
        far = max(places, key=lambda p: math.dist(here, p))
        here = tuple(a + (b - a) / (step + 1) for a, b in zip(here, far, strict=True))
    return here


def median(points: Sequence[Point], weights: Sequence[float]) -> Point:
    """The geometric median by weight."""
    pairs = sorted(zip(points, weights, strict=True))
    places, shares = [p for p, _ in pairs], [w for _, w in pairs]
    best = min(places, key=lambda p: (_ways(p, places, shares), p))
    here = mean(places, shares)
    for _ in range(STEPS):
        near = [w / max(math.dist(here, p), SLACK) for p, w in pairs]
        here = mean(places, near)
    # Where the median is one of the places, the steps only creep towards it.
    return best if _ways(best, places, shares) <= _ways(here, places, shares) else here


def _ways(here: Point, places: Sequence[Point], weights: Sequence[float]) -> float:
    return math.fsum(w * math.dist(here, p) for p, w in zip(places, weights, strict=True))


def _circle(places: Sequence[Point]) -> tuple[Point, float]:
    """The smallest circle, a point at a time (Welzl 1991, without dice: the points come in their order)."""
    found = (places[0], 0.0)
    for i, p in enumerate(places):
        if not _holds(found, p):
            found = (p, 0.0)
            for j, q in enumerate(places[:i]):
                if not _holds(found, q):
                    found = _around(p, q)
                    for r in places[:j]:
                        if not _holds(found, r):
                            found = _around(p, q, r)
    return found


def _holds(circle: tuple[Point, float], place: Point) -> bool:
    return math.dist(circle[0], place) <= circle[1] * (1.0 + SLACK) + SLACK * SLACK


def _around(*places: Point) -> tuple[Point, float]:
    """The circle through three points, or over two; of three on a line, over the two that are farthest apart."""
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


def _in_hull(place: Point, places: Sequence[Point]) -> Point:
    """Rounding must not put it outside the box of the points."""
    sides = zip(place, zip(*places, strict=True), strict=True)
    return tuple(min(max(x, min(numbers)), max(numbers)) for x, numbers in sides)
