"""Scenarios: faults with their times, loaded from a TOML file, so that a run can be repeated."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from formats.convert import InvalidValue, Unit, convert_table
from middleware.errors import BadFault, BadSetting
from middleware.faults.kinds import Fault, parse_fault

EXECUTING_DEVICE, ANY_DEVICE = "executing", "any"
MAX_FAULTS, MAX_AT_S = 100, 3600.0


@dataclass(frozen=True)
class _FaultTable:
    """A table ``[[fault]]``; ``parse_fault`` checks the kind, the seconds and the amount."""

    kind: Any = None
    at: Annotated[float, Meta(ge=0.0, le=MAX_AT_S), Unit("seconds")] = 0.0
    device: Annotated[str, Meta(min_length=1, examples=[EXECUTING_DEVICE])] = EXECUTING_DEVICE
    seconds: Any = None
    amount: Any = None


@dataclass(frozen=True)
class _File:
    """The content of the file."""

    fault: Annotated[list[Any], Meta(min_length=1, max_length=MAX_FAULTS, description="1 to 100 tables [[fault]]")]
    seed: Annotated[int, Meta(ge=0)] = 1
    task: Annotated[str, Meta(examples=["turn-around"])] = ""


@dataclass(frozen=True)
class Step:
    """One fault, ``at`` seconds after the start; ``device`` is a name, ``EXECUTING_DEVICE`` or ``ANY_DEVICE``."""

    at: float
    device: str
    fault: Fault


@dataclass(frozen=True)
class Scenario:
    """The name of a predefined task that is assigned first (empty: no task), and the faults in order of time.

    ``seed`` is the seed of the random choice of devices for ``ANY_DEVICE``.
    """

    task: str
    steps: tuple[Step, ...]
    seed: int = 1


def load_scenario(path: Path) -> Scenario:
    """Load a scenario file; raises ``BadSetting``."""
    try:
        return parse_scenario(tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise BadSetting(
            str(path), "", problem, "use a readable file, such as examples/scenarios/takeover.toml"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadSetting(str(path), "", f"is not TOML: {error}", "fix that line") from error


def parse_scenario(content: Mapping[str, Any], origin: str) -> Scenario:
    """Parse the content of a scenario file; raises ``BadSetting``."""
    try:
        file = convert_table(content, _File)
    except InvalidValue as error:
        key = "[[fault]]" if error.key == "fault" else error.key
        raise BadSetting(origin, key, error.problem, error.remedy) from None
    steps = [_parse_step(fault, origin, f"[[fault]] {number}") for number, fault in enumerate(file.fault, start=1)]
    return Scenario(file.task, tuple(sorted(steps, key=lambda step: step.at)), file.seed)


def _parse_step(content: Any, origin: str, where: str) -> Step:
    try:
        table = convert_table(content, _FaultTable)
        return Step(table.at, table.device, parse_fault(table.kind, table.seconds, table.amount))
    except InvalidValue as error:
        raise BadSetting(origin, f"{where} {error.key}".strip(), error.problem, error.remedy) from None
    except BadFault as error:
        raise BadSetting(origin, f"{where} {error.field}", error.problem, error.remedy) from error
