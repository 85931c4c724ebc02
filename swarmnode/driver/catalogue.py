"""Catalogue: the kinds of robot that there are drivers for, a line each, and what has to be installed for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

from drivers.errors import UsageError
from drivers.foreign import maker, places
from drivers.registry import built_in_kinds, kinds, manifest_of


@dataclass(frozen=True)
class Entry:
    """One kind; ``is_ready`` where nothing has to be installed first, ``problem`` where it cannot be loaded."""

    kind: str
    about: str
    needs: str = ""
    is_ready: bool = True
    problem: str = ""


def catalogue(is_there: Callable[[str], bool] = lambda library: find_spec(library) is not None) -> list[Entry]:
    """Every kind there is; a broken one of another distribution is told as such, and the others are as they are."""
    built_in, foreign = built_in_kinds(), places()
    return [
        _built_in(kind, is_there) if kind in built_in else _foreign(kind, foreign[kind])
        for kind in kinds()
        if kind in built_in or kind in foreign
    ]


def lines(entries: list[Entry]) -> list[str]:
    """The catalogue for a person."""
    width = max((len(entry.kind) for entry in entries), default=0)
    told = []
    for entry in entries:
        told.append(f"{entry.kind:{width}}  {entry.problem or entry.about}")
        if entry.needs:
            told.append(f"{'':{width}}  {entry.needs}")
    return told


def _built_in(kind: str, is_there: Callable[[str], bool]) -> Entry:
    package = import_module(f"drivers.{kind}")
    about = (package.__doc__ or "").strip().split("\n")[0].partition(": ")[0].rstrip(".")
    manifest = manifest_of(kind)
    if not manifest.library or is_there(manifest.library):
        return Entry(kind, about)
    return Entry(
        kind, about, f"pip install 'swarm-node[{manifest.extra}]'{manifest.when and ', ' + manifest.when}", False
    )


def _foreign(kind: str, place: str) -> Entry:
    try:
        made: object = getattr(maker(kind, place), "args", (kind, None))[1]
    except UsageError as error:
        return Entry(kind, "", "", False, f"broken: {error}")
    about = (getattr(made, "__doc__", None) or "").strip().split("\n")[0].rstrip(".")
    return Entry(kind, f"{about or 'a driver of another distribution'} ({place})")
