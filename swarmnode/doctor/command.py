"""Command: ``swarm doctor``, which names what keeps a node from its team, with the reason and the remedy."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, TextIO

from middleware.config.settings import Settings
from middleware.entangled.control.command import Ask, asked
from middleware.entangled.control.link import Link, link
from middleware.entangled.control.place import NoControl, found
from middleware.entangled.control.word import printable
from middleware.entangled.network.interface import interfaces
from middleware.errors import SwarmError
from swarmnode.doctor.diagnosis import diagnosed
from swarmnode.doctor.facts import Facts, Finding, Health
from swarmnode.doctor.measure import measured
from swarmnode.links import figures
from swarmnode.world import resolved

WELL, ILL, WRONG = 0, 1, 2
Measure = Callable[[Settings, bool, Health | None], Facts]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    doctor = argparse.ArgumentParser(
        prog="swarm doctor", description="Name what keeps a node from its team, and what to do about it."
    )
    doctor.add_argument("settings", nargs="?", metavar="SETTINGS", help="the node's TOML file; none: a running node")
    doctor.add_argument("--node", metavar="NAME", help="which running node of this machine, where several run")
    doctor.add_argument("--json", action="store_true", help="answer in JSON, on one line")
    return doctor


def main(
    words: Sequence[str] | None = None, out: TextIO | None = None, ask: Ask = asked, measure: Measure = measured
) -> int:
    """Run the command; returns 0 where nothing is wrong, 1 where something is, 2 where the command or a file is."""
    out = out or sys.stdout
    wishes = parser().parse_args(words)
    try:
        settings = resolved(Settings.load(wishes.settings)) if wishes.settings else None
        name = wishes.node or (settings.node.name if settings is not None else None)
        answers = _running(name, ask)
        if settings is None:
            if answers is None:
                raise NoControl(_not_running(name))
            facts = _of_the_node_alone(name or "", answers[0])
        else:
            facts = measure(settings, answers is not None, None if answers is None else _health(answers[0]))
    except (SwarmError, NoControl) as problem:
        sys.stderr.write(printable(f"swarm doctor: {problem}") + "\n")
        return WRONG
    findings = diagnosed(facts)
    links = [] if answers is None else [_link(each) for each in answers[1]]
    out.write(_as_json(findings, links) if wishes.json else _as_text(findings, links, answers is not None))
    return ILL if any(finding.weight != "note" for finding in findings) else WELL


def _running(name: str | None, ask: Ask) -> tuple[dict[str, Any], list[dict[str, Any]]] | None:
    """What the running node says of itself and of its links; None where it does not run."""
    try:
        path = found(name)
        said: list[Any] = []
        for verb in ("health", "links"):
            line: dict[str, Any] = next(iter(ask(path, {"verb": verb, "with": {}})), {})
            if "answer" not in line:
                return None
            said.append(line["answer"])
    except NoControl:
        return None
    return said[0], said[1]


def _not_running(name: str | None) -> str:
    which = f"no node {name!r} runs here" if name else "no node, or more than one, runs here"
    return f"{which}; name its settings: swarm doctor SETTINGS, or say --node NAME"


def _health(said: dict[str, Any]) -> Health:
    refusals = tuple((str(code), str(whom)) for code, whom in said.get("refusals", []))
    figures = {key: int(said[key]) for key in ("contacts", "rows", "max_rows", "bytes", "max_bytes")}
    return Health(**figures, trouble=str(said.get("trouble", "")), refusals=refusals)


def _of_the_node_alone(name: str, said: dict[str, Any]) -> Facts:
    host, _, port = str(said["address"]).rpartition(":")
    return Facts(name, host, int(port), 0.0, tuple(interfaces()), is_running=True, health=_health(said))


def _link(said: dict[str, Any]) -> tuple[str, str, Link]:
    return str(said["id"]), str(said["address"]), link(said["times"], bool(said["relayed"]))


def _as_json(findings: Sequence[Finding], links: Sequence[tuple[str, str, Link]]) -> str:
    told = [
        {"id": node_id, "address": address, "score": each.score, **asdict(each)} for node_id, address, each in links
    ]
    return json.dumps({"findings": [asdict(finding) for finding in findings], "links": told}) + "\n"


def _as_text(findings: Sequence[Finding], links: Sequence[tuple[str, str, Link]], is_running: bool) -> str:
    lines = []
    for finding in findings:
        lines += [
            f"{finding.weight.upper()}  {finding.cause}: {finding.what}",
            f"    why: {finding.why}",
            f"    do:  {finding.remedy}",
        ]
    for node_id, address, each in links:
        relayed = ", relayed" if each.is_relayed and each.round_trip is not None else ""
        lines.append(f"link  {node_id[:10]}  {address}  {each.score:3}/100  {figures(each)}{relayed}")
    if not findings:
        lines.append("nothing is wrong" if is_running else "nothing is wrong that can be seen while the node is off")
    return "".join(printable(line) + "\n" for line in lines)
