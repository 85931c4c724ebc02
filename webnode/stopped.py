"""Stopped: who of the team stands, by what each device says itself.  Pure.

``halted`` is true only where every robot says that it stands for every stop in force: a stop that was ordered and not
confirmed is shown as such, and so is a robot that has not heard a release.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from middleware.directory.presence import STOPS_SHOWN
from middleware.stop.halt import STANDS
from webnode.state import GONE, State

MOST = 64
"""Stops that the page names; when these are released it names the next ones."""


def stopped_view(stops: Mapping[str, str], devices: Iterable[State]) -> State:
    """``halted``, and in ``halt`` the stops, how many robots stand, and what the others say.

    ``stops`` (id to operator) are those that the team knows; ``devices`` are the rows of the page.  What a robot said
    before it left counts, as it stands until it hears a release.
    """
    robots = [row for row in devices if row["capabilities"]]
    standing = [row for row in robots if _stands(row, stops)]
    # A robot may obey a stop whose records are gone: the page has to name it, or no operator could release it.
    known = {**dict.fromkeys((stop for row in robots for stop in row["stops"]), ""), **stops}
    others = [{"name": row["name"], "says": _says(row)} for row in robots if row not in standing]
    return {
        "halted": bool(known) and not others,
        "halt": {
            "ordered": bool(stops),
            "stops": [{"id": stop, "by": known[stop]} for stop in sorted(known)[:MOST]],
            "standing": [row["name"] for row in standing],
            "others": others if known else [],
        },
    }


def _stands(row: Mapping[str, Any], stops: Mapping[str, str]) -> bool:
    obeyed = set(row["stops"])
    return bool(row["obeys"] == STANDS and obeyed and (obeyed >= set(stops) or len(obeyed) == STOPS_SHOWN))


def _says(row: Mapping[str, Any]) -> str:
    if row["status"] == GONE:
        return "is gone and has not confirmed"
    return "has not confirmed" if row["obeys"] in ("", STANDS) else str(row["obeys"])
