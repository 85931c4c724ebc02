"""Links: ``swarm links``, how a node of this machine reaches each of its peers, and how well.

The figures are those of the page and of ``swarm doctor``: small questions to each peer, judged by
``middleware.entangled.control.link``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TextIO

from middleware.entangled.control.command import FAILED, WRONG, Ask, asked
from middleware.entangled.control.link import Link, link
from middleware.entangled.control.place import NoControl
from middleware.entangled.control.word import printable
from swarmnode.asker import Asker, Refusal

WAYS = {
    "none": "no way yet",
    "machine": "this machine",
    "lan": "LAN",
    "direct": "direct",
    "punched": "punched",
    "tunnel": "tunnel",
}
SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    links = argparse.ArgumentParser(
        prog="swarm links",
        description="Print how a node reaches each of its peers, and how well, from 0 (not at all) to 100.",
    )
    links.add_argument("--node", metavar="NAME", help="which node of this machine, where several run")
    links.add_argument("--json", action="store_true", help="answer in JSON, on one line")
    return links


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: Ask = asked) -> int:
    """Run the command; returns 0, 1 where the node refused or a peer does not answer, 2 where nobody can be asked."""
    out = out or sys.stdout
    wishes = parser().parse_args(words)
    try:
        asker = Asker(wishes.node, ask)
        told = asker.links()
        names = {device.uuid: device.name for device, _ in asker.devices()}
    except (Refusal, NoControl) as problem:
        sys.stderr.write(printable(f"swarm links: {problem}") + "\n")
        return FAILED if isinstance(problem, Refusal) else WRONG
    judged = sorted(((each, _judged(each)) for each in told), key=lambda pair: (pair[1].score, pair[0]["id"]))
    out.write(_as_json(judged, names) if wishes.json else _as_text(judged, names))
    return FAILED if any(found.round_trip is None for _, found in judged) else 0


def figures(found: Link) -> str:
    """Round trip, jitter and loss for people."""
    if found.round_trip is None or found.jitter is None:
        return "does not answer"
    return f"{1000 * found.round_trip:.1f} ms, jitter {1000 * found.jitter:.1f} ms, {100 * found.loss:.0f} % lost"


def _judged(told: dict[str, Any]) -> Link:
    return link(told["times"], bool(told["relayed"]))


def _as_json(judged: Sequence[tuple[dict[str, Any], Link]], names: dict[str, str]) -> str:
    rows = [
        {"name": names.get(each["id"], ""), **{key: each[key] for key in ("id", "address", "way", "by", "for")}}
        | {"score": found.score, **asdict(found)}
        for each, found in judged
    ]
    return json.dumps({"links": rows}) + "\n"


def _as_text(judged: Sequence[tuple[dict[str, Any], Link]], names: dict[str, str]) -> str:
    if not judged:
        return "this node knows no peer; swarm doctor says why\n"
    rows = [(_name(each["id"], names), _way(each, names), each, found) for each, found in judged]
    wide, far = (max(len(row[place]) for row in rows) for place in (0, 1))  # type: ignore[arg-type]
    lines = [
        f"{name:{wide}}  {found.score:3}/100  {way:{far}}  {figures(found)}{_span(each['for'])}"
        for name, way, each, found in rows
    ]
    return "".join(printable(line) + "\n" for line in lines)


def _name(node_id: str, names: dict[str, str]) -> str:
    return names.get(node_id) or node_id[:10]


def _way(told: dict[str, Any], names: dict[str, str]) -> str:
    if told["way"] == "carried":
        return f"carried by {_name(told['by'], names)}" if told["by"] else "carried by nobody now"
    return WAYS.get(told["way"], str(told["way"]))


def _span(seconds: float | None) -> str:
    if seconds is None:
        return ""
    unit, size = next(((unit, size) for unit, size in SPANS if seconds >= 2 * size), SPANS[-1])
    return f", for {seconds / size:.0f} {unit}"


if __name__ == "__main__":
    raise SystemExit(main())
