"""``swarm doctor``: print what prevents a node from reaching its team, with reason and remedy."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, TextIO

from middleware.config.settings import Settings
from middleware.entangled.control.command import SendRequest, send_request
from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.control.link_quality import LinkQuality, compute_quality
from middleware.entangled.control.socket_path import NoControl, find_socket
from middleware.entangled.network.interface import list_interfaces
from middleware.errors import SwarmError
from swarmnode.doctor.diagnosis import diagnose
from swarmnode.doctor.facts import Facts, Finding, Health
from swarmnode.doctor.measure import measure_facts
from swarmnode.environment import resolve_hosts
from swarmnode.links import format_link

NO_PROBLEM, PROBLEM_FOUND, INVALID_COMMAND = 0, 1, 2
MeasureFacts = Callable[[Settings, bool, Health | None], Facts]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    doctor = argparse.ArgumentParser(
        prog="swarm doctor",
        description="Diagnose why a node does not reach its team, and print the remedies.",
        epilog="Example: swarm doctor dog1.toml",
    )
    doctor.add_argument("settings", nargs="?", metavar="SETTINGS", help="settings file (default: a running node)")
    doctor.add_argument("--node", metavar="NAME", help="name of the running node, if several run on this machine")
    doctor.add_argument("--json", action="store_true", help="print JSON, on one line")
    return doctor


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    ask: SendRequest = send_request,
    measure: MeasureFacts = measure_facts,
) -> int:
    """Run the command; returns 0 if there is no problem, 1 if there is one, 2 if the command or a file is wrong."""
    out = out or sys.stdout
    options = make_parser().parse_args(words)
    try:
        settings = resolve_hosts(Settings.load(options.settings)) if options.settings else None
        name = options.node or (settings.node.name if settings is not None else None)
        answers = _ask_node(name, ask)
        if settings is None:
            if answers is None:
                raise NoControl(_describe_not_running(name))
            facts = _make_running_facts(name or "", answers[0])
        else:
            facts = measure(settings, answers is not None, None if answers is None else _parse_health(answers[0]))
    except (SwarmError, NoControl) as problem:
        sys.stderr.write(remove_control_characters(f"swarm doctor: {problem}") + "\n")
        return INVALID_COMMAND
    findings = diagnose(facts)
    links = [] if answers is None else [_parse_link(each) for each in answers[1]]
    out.write(_to_json(findings, links) if options.json else _format_text(findings, links, answers is not None))
    return PROBLEM_FOUND if any(finding.weight != "note" for finding in findings) else NO_PROBLEM


def _ask_node(name: str | None, ask: SendRequest) -> tuple[dict[str, Any], list[dict[str, Any]]] | None:
    """Return the health and the links of the running node, or None if no such node runs."""
    try:
        path = find_socket(name)
        answer: list[Any] = []
        for verb in ("health", "links"):
            line: dict[str, Any] = next(iter(ask(path, {"verb": verb, "with": {}})), {})
            if "answer" not in line:
                return None
            answer.append(line["answer"])
    except NoControl:
        return None
    return answer[0], answer[1]


def _describe_not_running(name: str | None) -> str:
    which = f"node {name!r} does not run on this machine" if name else "no node, or more than one, runs on this machine"
    return f"{which}; pass its settings file (swarm doctor SETTINGS), or --node NAME"


def _parse_health(answer: dict[str, Any]) -> Health:
    refusals = tuple((str(code), str(peer)) for code, peer in answer.get("refusals", []))
    figures = {key: int(answer[key]) for key in ("contacts", "rows", "max_rows", "bytes", "max_bytes")}
    return Health(**figures, trouble=str(answer.get("trouble", "")), refusals=refusals)


def _make_running_facts(name: str, answer: dict[str, Any]) -> Facts:
    host, _, port = str(answer["address"]).rpartition(":")
    return Facts(name, host, int(port), 0.0, tuple(list_interfaces()), is_running=True, health=_parse_health(answer))


def _parse_link(answer: dict[str, Any]) -> tuple[str, str, LinkQuality]:
    return str(answer["id"]), str(answer["address"]), compute_quality(answer["times"], bool(answer["relayed"]))


def _to_json(findings: Sequence[Finding], links: Sequence[tuple[str, str, LinkQuality]]) -> str:
    rows = [
        {"id": node_id, "address": address, "score": each.score, **asdict(each)} for node_id, address, each in links
    ]
    return json.dumps({"findings": [asdict(finding) for finding in findings], "links": rows}) + "\n"


def _format_text(findings: Sequence[Finding], links: Sequence[tuple[str, str, LinkQuality]], is_running: bool) -> str:
    lines = []
    for finding in findings:
        lines += [
            f"{finding.weight.upper()}  {finding.cause}: {finding.what}",
            f"    why: {finding.why}",
            f"    do:  {finding.remedy}",
        ]
    for node_id, address, each in links:
        relayed = ", relayed" if each.is_relayed and each.round_trip is not None else ""
        lines.append(f"link  {node_id[:10]}  {address}  {each.score:3}/100  {format_link(each)}{relayed}")
    if not findings:
        lines.append("no problem found" if is_running else "no problem found; run it again while the node runs")
    return "".join(remove_control_characters(line) + "\n" for line in lines)
