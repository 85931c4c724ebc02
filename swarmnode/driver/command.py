"""Command: ``swarm driver``, to find a robot and try it in a terminal before it joins a team."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

from drivers.driver import Driver
from drivers.errors import DriverError
from middleware.entangled.control.word import printable
from middleware.errors import BadSetting
from swarmnode.driver.choice import Choice, add_arguments, chosen, meant
from swarmnode.driver.ground import Ear, Ground, RealGround

FAILED, WRONG = 1, 2
"""Exit codes: the robot is not there or not well; the command is wrong."""

Say = Callable[[Iterable[str]], None]
Problems = Callable[[], list[str]]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    whole = argparse.ArgumentParser(
        prog="swarm driver", description="Find a robot, and try it in a terminal before it joins a team."
    )
    verbs = whole.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, purpose: str) -> argparse.ArgumentParser:
        return verbs.add_parser(name, help=purpose, description=purpose)

    listing = verb("list", "Print the kinds of robot, and what has to be installed for them.")
    info = verb("info", "Print what a robot is and can do, without a connection.")
    info.add_argument("robot", metavar="KIND|FILE", help="a kind of robot, or the settings of a node")
    probe = verb("probe", "Connect for some seconds, move nothing, and say what came, or what is wrong.")
    drive = verb("drive", "Drive a robot by keys: w a s d q e, space to stop, x to end.")
    monitor = verb("monitor", "Print the readings of a robot; move nothing.")
    for each in (info, probe, drive, monitor):
        add_arguments(each)
    for each in (listing, info, probe, monitor):
        each.add_argument("--json", action="store_true", help="answer in JSON, each answer on a line")
    probe.add_argument("--seconds", type=_seconds, default=3.0, help="how long to listen to it; 3 if not said")
    monitor.add_argument("--seconds", type=_seconds, default=math.inf, help="how long; until Ctrl-C if not said")
    monitor.add_argument("--picture", type=Path, metavar="FILE", help="save the newest picture there, each second")
    return whole


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ground: Ground | None = None) -> int:
    """Run the command; returns 0, 1 where the robot is not there or not well, 2 where the command is wrong."""
    out = out or sys.stdout
    wishes = parser().parse_args(words)

    def say(told: Iterable[str]) -> None:
        out.write("".join(f"{printable(line)}\n" for line in told))
        out.flush()

    try:
        if wishes.verb == "list":
            return _list(wishes, say)
        if wishes.verb == "info":
            return _info(wishes, say)
        ground = ground or RealGround()
        choice = chosen(wishes)
        if choice is None:
            return _candidates(wishes, say)
        return _run(wishes, choice, ground, say)
    except (DriverError, BadSetting) as problem:
        sys.stderr.write(f"swarm driver {wishes.verb}: {printable(str(problem))}\n")
        return WRONG


def _list(wishes: argparse.Namespace, say: Say) -> int:
    from swarmnode.driver.catalogue import catalogue, catalogue_lines

    entries = catalogue()
    say([json.dumps([asdict(entry) for entry in entries])] if wishes.json else catalogue_lines(entries))
    return 0


def _info(wishes: argparse.Namespace, say: Say) -> int:
    from swarmnode.driver.sheet import lines

    body = meant(wishes.robot, wishes).description()
    say([json.dumps(asdict(body))] if wishes.json else lines(body))
    return 0


def _candidates(wishes: argparse.Namespace, say: Say) -> int:
    from swarmnode.driver.catalogue import candidate_lines, candidates

    found = candidates()
    if wishes.verb != "probe":
        sys.stderr.write(f"swarm driver {wishes.verb}: name the robot by --kind and --option, or by --config\n")
        return WRONG
    say([json.dumps([asdict(each) for each in found])] if wishes.json else candidate_lines(found))
    return 0 if found else FAILED


def _run(wishes: argparse.Namespace, choice: Choice, ground: Ground, say: Say) -> int:
    """Make a driver of the robot, and probe, drive or monitor it."""
    connector, of_links = ground.connector(wishes.verb == "drive")
    driver = choice.driver(ground.clock, connector)
    ear = Ear()

    def problems() -> list[str]:
        return [*of_links(), *ear.heard]

    try:
        return {"probe": _probe, "drive": _drive, "monitor": _monitor}[wishes.verb](
            wishes, driver, ground, say, problems
        )
    finally:
        ear.close()


def _probe(wishes: argparse.Namespace, driver: Driver, ground: Ground, say: Say, problems: Problems) -> int:
    from swarmnode.driver.probe import Probe, lines

    probe = Probe(driver, ground.clock, wishes.seconds, problems)
    finding = ground.run(probe.start, probe.end)
    say([json.dumps(finding.as_data())] if wishes.json else lines(finding))
    return 0 if finding.is_there else FAILED


def _drive(wishes: argparse.Namespace, driver: Driver, ground: Ground, say: Say, problems: Problems) -> int:
    from swarmnode.driver.drive import Drive

    if not driver.description.limits:
        sys.stderr.write(f"swarm driver drive: a {driver.description.kind} does not move; look at it by monitor\n")
        return WRONG
    terminal = ground.terminal()
    try:
        drive = Drive(driver, ground.clock, terminal, problems)
        return int(ground.run(drive.start, drive.end))
    finally:
        terminal.close()


def _monitor(wishes: argparse.Namespace, driver: Driver, ground: Ground, say: Say, problems: Problems) -> int:
    from swarmnode.driver.monitor import Monitor

    monitor = Monitor(driver, ground.clock, say, wishes.seconds, wishes.picture, wishes.json, problems)
    return int(ground.run(monitor.start, monitor.end))


def _seconds(text: str) -> Any:
    seconds = float(text)
    if not 0.0 < seconds <= 86_400.0:
        raise ValueError(text)
    return seconds
