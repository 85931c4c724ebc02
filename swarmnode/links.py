"""``swarm links``: path and quality of a node's link to each of its peers.

The page and ``swarm doctor`` show the same values: round-trip times of small probes, rated by
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
    "none": "no path yet",
    "machine": "this machine",
    "lan": "LAN",
    "direct": "direct",
    "punched": "hole punched",
    "tunnel": "tunnel",
}
SPANS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    links = argparse.ArgumentParser(
        prog="swarm links",
        description="Show path and quality of a node's link to each peer; quality is from 0 (no reply) to 100.",
        epilog="Example: swarm links --node dog1",
    )
    links.add_argument("--node", metavar="NAME", help="node on this machine, if several run")
    links.add_argument("--json", action="store_true", help="print JSON, on one line")
    return links


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: Ask = asked) -> int:
    """Run the command; returns 0, 1 if the node refused or a peer does not reply, 2 if no node can be asked."""
    out = out or sys.stdout
    options = parser().parse_args(words)
    try:
        asker = Asker(options.node, ask)
        links = asker.links()
        names = {device.uuid: device.name for device, _ in asker.devices()}
    except (Refusal, NoControl) as problem:
        sys.stderr.write(printable(f"swarm links: {problem}") + "\n")
        return FAILED if isinstance(problem, Refusal) else WRONG
    rated = sorted(((each, _rate(each)) for each in links), key=lambda pair: (pair[1].score, pair[0]["id"]))
    out.write(_as_json(rated, names) if options.json else _as_text(rated, names))
    return FAILED if any(found.round_trip is None for _, found in rated) else 0


def figures(found: Link) -> str:
    """Return round-trip time, jitter and loss as text."""
    if found.round_trip is None or found.jitter is None:
        return "does not reply"
    return f"{1000 * found.round_trip:.1f} ms, jitter {1000 * found.jitter:.1f} ms, {100 * found.loss:.0f} % lost"


def _rate(row: dict[str, Any]) -> Link:
    return link(row["times"], bool(row["relayed"]))


def _as_json(rated: Sequence[tuple[dict[str, Any], Link]], names: dict[str, str]) -> str:
    rows = [
        {"name": names.get(each["id"], ""), **{key: each[key] for key in ("id", "address", "way", "by", "for")}}
        | {"score": found.score, **asdict(found)}
        for each, found in rated
    ]
    return json.dumps({"links": rows}) + "\n"


def _as_text(rated: Sequence[tuple[dict[str, Any], Link]], names: dict[str, str]) -> str:
    if not rated:
        return "this node has no peers; run swarm doctor to see why\n"
    rows = [(_name(each["id"], names), _path(each, names), each, found) for each, found in rated]
    wide, far = (max(len(each[place]) for each in rows) for place in (0, 1))  # type: ignore[arg-type]
    lines = [
        f"{name:{wide}}  {found.score:3}/100  {path:{far}}  {figures(found)}{_span(each['for'])}"
        for name, path, each, found in rows
    ]
    return "".join(printable(line) + "\n" for line in lines)


def _name(node_id: str, names: dict[str, str]) -> str:
    return names.get(node_id) or node_id[:10]


def _path(row: dict[str, Any], names: dict[str, str]) -> str:
    if row["way"] == "carried":
        return f"relayed by {_name(row['by'], names)}" if row["by"] else "relay lost"
    return WAYS.get(row["way"], str(row["way"]))


def _span(seconds: float | None) -> str:
    if seconds is None:
        return ""
    unit, size = next(((unit, size) for unit, size in SPANS if seconds >= 2 * size), SPANS[-1])
    return f", for {seconds / size:.0f} {unit}"


if __name__ == "__main__":
    raise SystemExit(main())
