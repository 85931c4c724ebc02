"""Selection of a robot by command line arguments or by the settings of its node."""

from __future__ import annotations

import argparse
import os
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from drivers.errors import UsageError
from drivers.reading import Description
from drivers.registry import create_driver, describe, load_manifest


@dataclass(frozen=True)
class RobotSelection:
    """One robot: kind, options, name and additional sensors."""

    kind: str
    options: Mapping[str, object] = field(default_factory=dict)
    name: str = "robot"
    parts: Sequence[Any] = ()

    def create_driver(self, clock: Any, connector: Any) -> Any:
        """Return a driver that is not connected; raises ``UsageError``."""
        return create_driver(self.kind, self.options, self.name, clock, connector, self.parts)

    def get_description(self) -> Description:
        """Return the description of the robot; raises ``UsageError``."""
        try:
            return describe(self.kind, self.options, self.name, self.parts)
        except UsageError:
            example = load_manifest(self.kind).example
            if self.options or not example:
                raise
            return describe(self.kind, example, self.name, self.parts)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that select a robot."""
    parser.add_argument("--kind", help="kind of robot: one of `swarm driver list`, or module:Class")
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the robot's driver; can be repeated",
    )
    parser.add_argument("--config", metavar="FILE", help="settings file of the robot's node, instead of --kind")
    parser.add_argument("--name", help="name of the robot; in a simulator it selects the robot")


def select_robot(arguments: argparse.Namespace) -> RobotSelection | None:
    """Return the selected robot, or None if no argument selects a robot; raises ``UsageError`` or ``BadSetting``."""
    if arguments.config and arguments.kind:
        raise UsageError("--kind and --config are both given; use only one of them")
    if arguments.config:
        return _select_by_settings(arguments.config, arguments)
    if arguments.kind:
        return _select_by_kind(arguments.kind, arguments)
    if arguments.option:
        raise UsageError("--option needs --kind; `swarm driver list` shows the kinds")
    return None


def select_robot_by_word(word: str, arguments: argparse.Namespace) -> RobotSelection:
    """Return the robot for a settings file or a kind; raises as ``select_robot`` does."""
    if word.endswith(".toml") or os.path.isfile(word):
        return _select_by_settings(word, arguments)
    return _select_by_kind(word, arguments)


def parse_options(words: Sequence[str]) -> dict[str, Any]:
    """Parse ``KEY=VALUE`` arguments: a value is TOML if possible, otherwise text; ``ports.walk=1`` makes a table."""
    table: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        names = key.split(".")
        if not equals or not all(names):
            raise UsageError(f"--option {word} is not KEY=VALUE; write for example --option host=192.168.0.51")
        inner = table
        for name in names[:-1]:
            inner = inner.setdefault(name, {})
            if not isinstance(inner, dict):
                raise UsageError(f"--option {key} is given both as a value and as a table")
        inner[names[-1]] = _parse_value(text)
    return table


def _parse_value(text: str) -> Any:
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, bool | int | float | str | list | dict) else text


def _add_working_directory(kind: str) -> None:
    """Make a driver module in the working directory importable."""
    if ":" in kind and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


def _select_by_kind(kind: str, arguments: argparse.Namespace) -> RobotSelection:
    _add_working_directory(kind)
    return RobotSelection(kind, parse_options(arguments.option), arguments.name or "robot")


def _select_by_settings(path: str, arguments: argparse.Namespace) -> RobotSelection:
    from middleware.config.settings import Settings

    settings = Settings.load(path)
    if not settings.driver.kind:
        raise UsageError(f'{path} has no robot; set kind = "..." in [driver]')
    _add_working_directory(settings.driver.kind)
    options = {**settings.driver.options, **parse_options(arguments.option)}
    parts = settings.driver.parts
    return RobotSelection(settings.driver.kind, options, arguments.name or settings.node.name, parts)
