"""Choice: which robot is meant, by the words of a command line or by the settings of its node."""

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
from drivers.registry import describe, driver_for, manifest_of


@dataclass(frozen=True)
class Choice:
    """One robot: its kind, its options, what it is called, and the parts on its back."""

    kind: str
    options: Mapping[str, object] = field(default_factory=dict)
    name: str = "robot"
    parts: Sequence[Any] = ()

    def driver(self, clock: Any, connector: Any) -> Any:
        """A driver of it that is not connected; raises ``UsageError``."""
        return driver_for(self.kind, self.options, self.name, clock, connector, self.parts)

    def description(self) -> Description:
        """What it is; raises ``UsageError``."""
        try:
            return describe(self.kind, self.options, self.name, self.parts)
        except UsageError:
            example = manifest_of(self.kind).example
            if self.options or not example:
                raise
            return describe(self.kind, example, self.name, self.parts)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How the command line names a robot."""
    parser.add_argument("--kind", help="the kind of robot: one of `swarm driver list`, or module:Class")
    parser.add_argument(
        "--option", action="append", default=[], metavar="KEY=VALUE", help="an option of its driver; again for each"
    )
    parser.add_argument("--config", metavar="FILE", help="the settings of its node, instead: its [driver]")
    parser.add_argument("--name", help="what it is called; of a yard, which dog")


def chosen(wishes: argparse.Namespace) -> Choice | None:
    """The robot that is meant, None where none is named; raises ``UsageError`` or ``BadSetting``."""
    if wishes.config and wishes.kind:
        raise UsageError("name the robot by --kind or by --config, not by both")
    if wishes.config:
        return _configured(wishes.config, wishes)
    if wishes.kind:
        return _named(wishes.kind, wishes)
    if wishes.option:
        raise UsageError("--option says nothing without --kind; `swarm driver list` shows the kinds")
    return None


def meant(word: str, wishes: argparse.Namespace) -> Choice:
    """The robot that one word means: a settings file, or a kind; raises as ``chosen`` does."""
    if word.endswith(".toml") or os.path.isfile(word):
        return _configured(word, wishes)
    return _named(word, wishes)


def options_of(words: Sequence[str]) -> dict[str, Any]:
    """``KEY=VALUE`` words as a table: a value is TOML where it can be read so, else text; ``ports.walk=1`` nests."""
    table: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        names = key.split(".")
        if not equals or not all(names):
            raise UsageError(f"--option is KEY=VALUE, as in --option host=192.168.0.51, not {word!r}")
        inner = table
        for name in names[:-1]:
            inner = inner.setdefault(name, {})
            if not isinstance(inner, dict):
                raise UsageError(f"--option {key} is given as a value and as a table")
        inner[names[-1]] = _value(text)
    return table


def _value(text: str) -> Any:
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, bool | int | float | str | list | dict) else text


def _look_here(kind: str) -> None:
    """A driver that is being written lies where one stands."""
    if ":" in kind and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


def _named(kind: str, wishes: argparse.Namespace) -> Choice:
    _look_here(kind)
    return Choice(kind, options_of(wishes.option), wishes.name or "robot")


def _configured(path: str, wishes: argparse.Namespace) -> Choice:
    from middleware.config.settings import Settings

    settings = Settings.load(path)
    if not settings.driver.kind:
        raise UsageError(f'{path} has no robot: it lacks [driver] kind = "..."')
    _look_here(settings.driver.kind)
    options = {**settings.driver.options, **options_of(wishes.option)}
    parts = settings.driver.parts
    return Choice(settings.driver.kind, options, wishes.name or settings.node.name, parts)
