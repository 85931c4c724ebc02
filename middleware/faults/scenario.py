"""A scenario: faults with their times from a TOML file, so that a run can be repeated."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from middleware.entangled.value import is_number, is_whole
from middleware.errors import BadFault, BadSetting
from middleware.faults.kinds import Fault, parse_fault

WHO_ACTS, ANY = "executing", "any"
MAX_FAULTS, MAX_AT = 100, 3600.0
KEYS = ("seed", "task", "fault")
FAULT_KEYS = ("at", "device", "kind", "seconds", "amount")


@dataclass(frozen=True)
class Step:
    """One fault: ``at`` seconds after the beginning, of the device of that name, of who acts then, or of any."""

    at: float
    device: str
    fault: Fault


@dataclass(frozen=True)
class Scenario:
    """A task of the catalogue that is assigned first (none where empty), and the faults in the order of their time.

    ``seed`` decides who "any" is.
    """

    task: str
    steps: tuple[Step, ...]
    seed: int = 1


def loaded(path: Path) -> Scenario:
    """The scenario in a file; raises ``BadSetting`` with what is to be mended."""
    try:
        return scenario_of(tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise BadSetting(str(path), "", problem, "name a scenario, such as examples/scenarios/takeover.toml") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise BadSetting(str(path), "", f"is not TOML: {error}", "mend that line") from error


def scenario_of(content: Mapping[str, Any], origin: str) -> Scenario:
    """The scenario that a file's content means; raises ``BadSetting``."""
    _known(content, KEYS, origin, "")
    seed, task, faults = content.get("seed", 1), content.get("task", ""), content.get("fault", [])
    if not is_whole(seed):
        raise BadSetting(origin, "seed", "must be a whole number from 0 on", "write seed = 7")
    if not isinstance(task, str):
        raise BadSetting(
            origin, "task", "must be a name of the catalogue", 'write task = "turn-around", or leave it out'
        )
    if not isinstance(faults, list) or not 0 < len(faults) <= MAX_FAULTS:
        raise BadSetting(origin, "[[fault]]", f"there must be 1 to {MAX_FAULTS}", "write a table [[fault]] for each")
    steps = [_step(fault, origin, f"[[fault]] {number}") for number, fault in enumerate(faults, start=1)]
    return Scenario(task, tuple(sorted(steps, key=lambda step: step.at)), seed)


def _step(table: Any, origin: str, where: str) -> Step:
    if not isinstance(table, Mapping):
        raise BadSetting(origin, where, "must be a table", "write [[fault]] and its keys below")
    _known(table, FAULT_KEYS, origin, where)
    at, device = table.get("at", 0.0), table.get("device", WHO_ACTS)
    if not is_number(at) or not 0 <= at <= MAX_AT:
        raise BadSetting(origin, f"{where} at", f"must be 0 to {MAX_AT:g} s after the beginning", "write at = 1.5")
    if not isinstance(device, str) or not device:
        raise BadSetting(
            origin, f"{where} device", "must be a text", f'write "{WHO_ACTS}", "{ANY}" or a device\'s name'
        )
    try:
        return Step(float(at), device, parse_fault(table.get("kind"), table.get("seconds"), table.get("amount")))
    except BadFault as error:
        raise BadSetting(origin, f"{where} {error.field}", error.problem, error.remedy) from error


def _known(table: Mapping[str, Any], keys: tuple[str, ...], origin: str, where: str) -> None:
    for key in table:
        if key not in keys:
            raise BadSetting(origin, f"{where} {key}".strip(), "is no such key", f"there are {', '.join(keys)}")
