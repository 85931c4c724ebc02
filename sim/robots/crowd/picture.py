"""A map of a crowd as SVG, without a library."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

from sim.robots.crowd.crowd import Crowd
from sim.robots.scene import FOOTPRINT_RADIUS_M

WIDTH, MARGIN, LINE = 900.0, 16.0, 20.0
OTHER = "others, batch controller"
INK = {
    OTHER: "#b9bdc4",
    "agents that search": "#2563a8",
    "agents that have found it": "#e08a1e",
    "the one that goes": "#1f8a4c",
}
"""Kinds of robots and their colours; a robot without a kind has the first colour."""
TARGET = "#d02228"


def draw_svg(
    crowd: Crowd, caption: str = "", kinds: Mapping[int, str] | None = None, trail: Sequence[tuple[float, float]] = ()
) -> str:
    """Draw the crowd with its target.

    ``kinds`` maps numbers of robots to keys of ``INK``; ``trail`` is the path of the selected robot.
    """
    kinds = kinds or {}
    scene = crowd.scene
    scale = (WIDTH - 2 * MARGIN) / scene.width
    high = scale * scene.height
    present_kinds = sorted({kinds.get(body, OTHER) for body in range(scene.robots)}, key=list(INK).index)

    def at(x: float, y: float) -> str:
        return f"{MARGIN + scale * x:.1f} {MARGIN + high - scale * y:.1f}"

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH:g}" height="{high + 2 * MARGIN + 2 * LINE:.0f}"'
        ' font-family="sans-serif" font-size="13">',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<rect x="{MARGIN:g}" y="{MARGIN:g}" width="{WIDTH - 2 * MARGIN:g}" height="{high:.1f}" fill="#f3f4f1"'
        ' stroke="#5c5852" stroke-width="2"/>',
    ]
    if len(trail) > 1:
        parts.append(f'<path d="M{" L".join(at(*place) for place in trail)}" fill="none" stroke="#1f8a4c"/>')
    rows = list(zip(crowd.x.tolist(), crowd.y.tolist(), crowd.heading.tolist(), strict=True))
    for kind in present_kinds:
        # One path per kind: a disc is a stroke of zero length with round ends; the mark of its heading is a short line.
        poses = [rows[body] for body in range(scene.robots) if kinds.get(body, OTHER) == kind]
        discs = "".join(f"M{at(x, y)}h0" for x, y, _ in poses)
        wide = f'stroke-width="{2 * FOOTPRINT_RADIUS_M * scale:.2f}" stroke-linecap="round"'
        parts.append(f'<path d="{discs}" stroke="{INK[kind]}" {wide}/>')
        noses = "".join(
            f"M{at(x, y)}L{at(x + FOOTPRINT_RADIUS_M * math.cos(turn), y + FOOTPRINT_RADIUS_M * math.sin(turn))}"
            for x, y, turn in poses
        )
        parts.append(f'<path d="{noses}" stroke="white" stroke-width="{0.3 * FOOTPRINT_RADIUS_M * scale:.2f}"/>')
    if crowd.target is not None:
        x, y = at(crowd.target.x, crowd.target.y).split()
        size = max(3.0, crowd.target.radius * scale)
        parts.append(f'<circle cx="{x}" cy="{y}" r="{size:.1f}" fill="{TARGET}"/>')
        parts.append(f'<circle cx="{x}" cy="{y}" r="{size + 8:.1f}" fill="none" stroke="{TARGET}"/>')
    left, line = MARGIN, high + 2 * MARGIN + 4
    for kind in present_kinds:
        parts.append(f'<circle cx="{left + 5:.0f}" cy="{line:.0f}" r="5" fill="{INK[kind]}"/>')
        parts.append(f'<text x="{left + 15:.0f}" y="{line + 4:.0f}">{escape(kind)}</text>')
        left += 40 + 7 * len(kind)
    parts.append(f'<text x="{MARGIN:g}" y="{line + 4 + LINE:.0f}">{escape(caption)}</text>')
    return "\n".join(parts) + "\n</svg>\n"
