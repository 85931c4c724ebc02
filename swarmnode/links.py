"""``swarm links``: path and quality of a node's link to each of its peers.

The page and ``swarm doctor`` show the same values: round-trip times of small probes, rated by
``middleware.entangled.control.link_quality``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, TextIO

from middleware.entangled.control.command import EXIT_FAILED, EXIT_USAGE, SendRequest, send_request
from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.control.link_quality import LinkQuality, compute_quality
from middleware.entangled.control.socket_path import NoControl
from swarmnode.control_client import ControlClient, Rejection

PATH_NAMES = {
    "none": "no path yet",
    "machine": "this machine",
    "lan": "LAN",
    "direct": "direct",
    "punched": "hole punched",
    "tunnel": "tunnel",
}
DURATION_UNITS = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    links = argparse.ArgumentParser(
        prog="swarm links",
        description="Show the path and quality of a node's link to each peer; the quality is from 0 (no reply) to 100.",
        epilog="Example: swarm links --node dog1",
    )
    links.add_argument("--node", metavar="NAME", help="name of the node, if several run on this machine")
    links.add_argument("--json", action="store_true", help="print JSON, on one line")
    return links


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: SendRequest = send_request) -> int:
    """Run the command; returns 0, 1 if the node rejected it or a peer does not reply, 2 if no node runs here."""
    out = out or sys.stdout
    options = make_parser().parse_args(words)
    try:
        client = ControlClient(options.node, ask)
        links = client.list_links()
        names = {device.uuid: device.name for device, _ in client.list_devices()}
    except (Rejection, NoControl) as problem:
        sys.stderr.write(remove_control_characters(f"swarm links: {problem}") + "\n")
        return EXIT_FAILED if isinstance(problem, Rejection) else EXIT_USAGE
    rated = sorted(((each, _rate_link(each)) for each in links), key=lambda pair: (pair[1].score, pair[0]["id"]))
    out.write(_to_json(rated, names) if options.json else _format_text(rated, names))
    return EXIT_FAILED if any(found.round_trip is None for _, found in rated) else 0


def format_link(found: LinkQuality) -> str:
    """Return round-trip time, jitter and loss as text."""
    if found.round_trip is None or found.jitter is None:
        return "does not reply"
    return f"{1000 * found.round_trip:.1f} ms, jitter {1000 * found.jitter:.1f} ms, {100 * found.loss:.0f} % lost"


def _rate_link(row: dict[str, Any]) -> LinkQuality:
    return compute_quality(row["times"], bool(row["relayed"]))


def _to_json(rated: Sequence[tuple[dict[str, Any], LinkQuality]], names: dict[str, str]) -> str:
    rows = [
        {"name": names.get(each["id"], ""), **{key: each[key] for key in ("id", "address", "way", "by", "for")}}
        | {"score": found.score, **asdict(found)}
        for each, found in rated
    ]
    return json.dumps({"links": rows}) + "\n"


def _format_text(rated: Sequence[tuple[dict[str, Any], LinkQuality]], names: dict[str, str]) -> str:
    if not rated:
        return "this node has no peers; run swarm doctor to see why\n"
    rows = [(_format_name(each["id"], names), _format_path(each, names), each, found) for each, found in rated]
    wide, far = (max(len(each[place]) for each in rows) for place in (0, 1))  # type: ignore[arg-type]
    lines = [
        f"{name:{wide}}  {found.score:3}/100  {path:{far}}  {format_link(found)}{_format_duration(each['for'])}"
        for name, path, each, found in rows
    ]
    return "".join(remove_control_characters(line) + "\n" for line in lines)


def _format_name(node_id: str, names: dict[str, str]) -> str:
    return names.get(node_id) or node_id[:10]


def _format_path(row: dict[str, Any], names: dict[str, str]) -> str:
    if row["way"] == "carried":
        return f"relayed by {_format_name(row['by'], names)}" if row["by"] else "relay lost"
    return PATH_NAMES.get(row["way"], str(row["way"]))


def _format_duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    unit, size = next(((unit, size) for unit, size in DURATION_UNITS if seconds >= 2 * size), DURATION_UNITS[-1])
    return f", for {seconds / size:.0f} {unit}"


if __name__ == "__main__":
    raise SystemExit(main())
