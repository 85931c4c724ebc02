"""``swarm driver``: commands to find a robot and test it in a terminal before it joins a team."""

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
from middleware.entangled.control.conversion import remove_control_characters
from middleware.errors import BadSetting
from swarmnode.driver.environment import CommandEnvironment, RealEnvironment, WarningCollector
from swarmnode.driver.selection import RobotSelection, add_arguments, select_robot, select_robot_by_word

FAILED, WRONG = 1, 2
"""Exit codes: the robot is not reachable or has a problem; the command is wrong."""

WriteLines = Callable[[Iterable[str]], None]
ListProblems = Callable[[], list[str]]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    main_parser = argparse.ArgumentParser(
        prog="swarm driver",
        description="Find a robot, and test it in a terminal before it joins a team.",
        epilog="Example: swarm driver probe --kind aibo --option host=192.168.0.51",
    )
    verbs = main_parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, purpose: str, example: str = " --kind aibo --option host=192.168.0.51") -> Any:
        epilog = f"Example: swarm driver {name}{example}"
        return verbs.add_parser(name, help=purpose, description=purpose, epilog=epilog)

    listing = verb("list", "List the kinds of robots, and the packages that they need.", "")
    info = verb("info", "Describe a robot and its capabilities, without a connection.", " aibo")
    info.add_argument("robot", metavar="KIND|FILE", help="kind of robot, or settings file of a node")
    probe = verb("probe", "Connect for some seconds without motion, and print the readings or the problems.")
    drive = verb("drive", "Drive a robot by keys: w a s d q e; space stops, x ends.")
    monitor = verb("monitor", "Print the readings of a robot, without motion.")
    for each in (info, probe, drive, monitor):
        add_arguments(each)
    for each in (listing, info, probe, monitor):
        each.add_argument("--json", action="store_true", help="print JSON, one line per result")
    probe.add_argument("--seconds", type=_parse_seconds, default=3.0, help="duration in seconds (default: 3)")
    monitor.add_argument(
        "--seconds", type=_parse_seconds, default=math.inf, help="duration in seconds (default: until Ctrl-C)"
    )
    monitor.add_argument("--picture", type=Path, metavar="FILE", help="save the newest picture to FILE every second")
    return main_parser


def main(
    words: Sequence[str] | None = None, out: TextIO | None = None, environment: CommandEnvironment | None = None
) -> int:
    """Run the command; returns 0, 1 if the robot is not reachable or has a problem, 2 if the command is wrong."""
    out = out or sys.stdout
    options = make_parser().parse_args(words)

    def say(lines: Iterable[str]) -> None:
        out.write("".join(f"{remove_control_characters(line)}\n" for line in lines))
        out.flush()

    try:
        if options.verb == "list":
            return _list(options, say)
        if options.verb == "info":
            return _info(options, say)
        environment = environment or RealEnvironment()
        selection = select_robot(options)
        if selection is None:
            return _list_devices(options, say)
        return _run(options, selection, environment, say)
    except (DriverError, BadSetting) as problem:
        sys.stderr.write(f"swarm driver {options.verb}: {remove_control_characters(str(problem))}\n")
        return WRONG


def _list(options: argparse.Namespace, say: WriteLines) -> int:
    from swarmnode.driver.catalogue import format_kind_entries, list_kind_entries

    entries = list_kind_entries()
    say([json.dumps([asdict(entry) for entry in entries])] if options.json else format_kind_entries(entries))
    return 0


def _info(options: argparse.Namespace, say: WriteLines) -> int:
    from swarmnode.driver.formatting import format_description

    body = select_robot_by_word(options.robot, options).get_description()
    say([json.dumps(asdict(body))] if options.json else format_description(body))
    return 0


def _list_devices(options: argparse.Namespace, say: WriteLines) -> int:
    from swarmnode.driver.catalogue import format_serial_devices, list_serial_devices

    found = list_serial_devices()
    if options.verb != "probe":
        sys.stderr.write(f"swarm driver {options.verb}: no robot is selected; pass --kind and --option, or --config\n")
        return WRONG
    say([json.dumps([asdict(each) for each in found])] if options.json else format_serial_devices(found))
    return 0 if found else FAILED


def _run(
    options: argparse.Namespace, selection: RobotSelection, environment: CommandEnvironment, say: WriteLines
) -> int:
    """Create a driver of the robot, and probe, drive or monitor it."""
    connector, of_links = environment.make_connector(options.verb == "drive")
    driver = selection.create_driver(environment.clock, connector)
    observer = WarningCollector()

    def problems() -> list[str]:
        return [*of_links(), *observer.warnings]

    try:
        return {"probe": _probe, "drive": _drive, "monitor": _monitor}[options.verb](
            options, driver, environment, say, problems
        )
    finally:
        observer.close()


def _probe(
    options: argparse.Namespace,
    driver: Driver,
    environment: CommandEnvironment,
    say: WriteLines,
    problems: ListProblems,
) -> int:
    from swarmnode.driver.probe import Probe, format_result

    probe = Probe(driver, environment.clock, options.seconds, problems)
    finding = environment.run(probe.start, probe.end)
    say([json.dumps(finding.to_data())] if options.json else format_result(finding))
    return 0 if finding.is_reachable else FAILED


def _drive(
    options: argparse.Namespace,
    driver: Driver,
    environment: CommandEnvironment,
    say: WriteLines,
    problems: ListProblems,
) -> int:
    from swarmnode.driver.drive import DriveSession

    if not driver.description.limits:
        kind = driver.description.kind
        sys.stderr.write(f"swarm driver drive: a robot of kind {kind} does not move; use swarm driver monitor\n")
        return WRONG
    terminal = environment.open_terminal()
    try:
        drive = DriveSession(driver, environment.clock, terminal, problems)
        return int(environment.run(drive.start, drive.end))
    finally:
        terminal.close()


def _monitor(
    options: argparse.Namespace,
    driver: Driver,
    environment: CommandEnvironment,
    say: WriteLines,
    problems: ListProblems,
) -> int:
    from swarmnode.driver.monitor import Monitor

    monitor = Monitor(driver, environment.clock, say, options.seconds, options.picture, options.json, problems)
    return int(environment.run(monitor.start, monitor.end))


def _parse_seconds(text: str) -> Any:
    seconds = float(text)
    if not 0.0 < seconds <= 86_400.0:
        raise ValueError(text)
    return seconds
