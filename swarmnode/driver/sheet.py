"""Sheet: what a robot is and can do, as its driver describes it before any connection."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from drivers.reading import Description
from swarmnode.driver.unit import unit_of


def as_data(body: Description) -> dict[str, Any]:
    """The description as plain data, for JSON."""
    return {
        "kind": body.kind,
        "model": body.model,
        "radius": body.radius,
        "capabilities": {name: dict(about) for name, about in body.capabilities.items()},
        "limits": {key: list(ends) for key, ends in body.limits.items()},
        "skills": list(body.skills),
        "rates": dict(body.rates),
    }


def lines(body: Description) -> Iterator[str]:
    """The description as a table."""
    yield f"{body.kind}: {body.model}"
    yield f"{'radius':14}{body.radius:g} m"
    yield from _rows("capabilities", {name: _properties(about) for name, about in body.capabilities.items()})
    limits = {
        key: f"{low:+.3g} to {high:+.3g} {unit_of(key)}".rstrip() for key, (low, high) in sorted(body.limits.items())
    }
    yield from _rows("limits", limits or {"none": "there is nothing that it can be told to do"})
    yield from _rows("rates", {name: f"{rate:g} a second" for name, rate in body.rates.items()})
    yield from _folded("skills", body.skills or ("none",))


def _properties(about: Mapping[str, float | str]) -> str:
    return ", ".join(
        f"{key} {value:g}" if isinstance(value, float | int) else f"{key} {value}" for key, value in about.items()
    )


def _rows(title: str, rows: Mapping[str, str]) -> Iterator[str]:
    width = max(map(len, rows), default=0)
    for number, (name, text) in enumerate(rows.items()):
        yield f"{title if number == 0 else '':14}{name:{width}}  {text}".rstrip()


def _folded(title: str, words: tuple[str, ...], width: int = 90) -> Iterator[str]:
    row = ""
    for word in words:
        if row and len(row) + len(word) > width:
            yield f"{title:14}{row.rstrip()}"
            title, row = "", ""
        row += word + " "
    yield f"{title:14}{row.rstrip()}"
