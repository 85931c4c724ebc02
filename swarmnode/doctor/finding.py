"""Finding: one cause that the doctor named: what, why it thinks so, and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Weight = Literal["error", "warning", "note"]
ORDER: tuple[Weight, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """``cause`` is a name for programs, such as ``udp-blocked``; the rest are sentences for people.

    An ``error`` keeps the node from its team, a ``warning`` will or may, a ``note`` is good to know.
    """

    weight: Weight
    cause: str
    what: str
    why: str
    remedy: str


def error(cause: str, what: str, why: str, remedy: str) -> Finding:
    """What keeps the node from its team."""
    return Finding("error", cause, what, why, remedy)


def warning(cause: str, what: str, why: str, remedy: str) -> Finding:
    """What may keep it, or will."""
    return Finding("warning", cause, what, why, remedy)


def note(cause: str, what: str, why: str, remedy: str) -> Finding:
    """What is good to know."""
    return Finding("note", cause, what, why, remedy)
