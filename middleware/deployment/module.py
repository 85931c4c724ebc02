"""Module: from an operator's source to something that can be called; the only place where pushed code is run.

It is called in the module's own process, after its rights were given up, and by the twin of that process in simulators.
The caller has checked who signed the source.  What is refused here are mistakes: what does not parse, raises, or never
comes to an end.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType, ModuleType
from typing import Any, TypeVar

from middleware.consensus.deployed import BEHAVIOUR, PREFIX, STRATEGY, Make
from middleware.consensus.strategy import Report
from middleware.deployment.manifest import MAX_SOURCE, Manifest, digest_of
from middleware.errors import Undeployable

ENTRIES = {STRATEGY: "Strategy", BEHAVIOUR: "Behaviour"}
"""The name that a module of each kind must define: a class, or whatever makes one of its kind."""
STEPS = 500_000
"""Instructions of Python that the import, and each check, may take: a fraction of a second."""
REPORTS = (Report("a" * 40, 2.0), Report("b" * 40, 1.0), Report("c" * 40, 1.0), Report("d" * 40, 3.5))

T = TypeVar("T")


class _TooLong(BaseException):
    """More than the allowed steps; no ``except Exception`` of the module may stop it."""


def loaded(manifest: Manifest, source: bytes) -> Make:
    """What makes the strategy or the behaviour of the module; runs its code.

    Raises ``Undeployable``, which says why not.
    """
    if len(source) != manifest.size or len(source) > MAX_SOURCE or digest_of(source) != manifest.digest:
        raise Undeployable(manifest.name, "its source is not what was signed")
    name = f"swarm_deployed_{manifest.name.replace('-', '_')}_{manifest.digest[:12]}"
    code = compiled(source, name)
    module = ModuleType(name)
    before = sys.modules.get(name)
    # Where a class looks up its own module (dataclasses do), it has to be found.
    sys.modules[name] = module
    try:
        within(STEPS, exec, code, module.__dict__)
        make = getattr(module, ENTRIES[manifest.kind], None)
        if not callable(make):
            raise Undeployable(manifest.name, f"a {manifest.kind} has to define {ENTRIES[manifest.kind]}")
        faults = within(STEPS, _faults, manifest.kind, make)
        if faults:
            raise Undeployable(manifest.name, faults[0])
    except Undeployable:
        _forget(name, before)
        raise
    except _TooLong:
        _forget(name, before)
        raise Undeployable(manifest.name, f"takes more than {STEPS} steps to load") from None
    except BaseException as error:  # foreign code; whatever it raises, the node lives on
        _forget(name, before)
        raise Undeployable(manifest.name, f"raises {type(error).__name__}: {error}") from error
    return _named(make, manifest)


def compiled(source: bytes, name: str) -> Any:
    """The code of a source; raises ``Undeployable`` with the line where it is no Python."""
    try:
        return compile(ast.parse(source, f"<{name}>"), f"<{name}>", "exec", dont_inherit=True)
    except SyntaxError as error:
        raise Undeployable(name, f"line {error.lineno or 0}: {error.msg}") from error
    except Exception as error:  # the parser raises others on crafted text (null bytes, deep nesting)
        raise Undeployable(name, f"is no Python: {error}") from error


def within(steps: int, call: Callable[..., T], *arguments: object) -> T:
    """What ``call`` returns if it takes at most ``steps`` instructions of Python; else raises.

    It ends loops that somebody wrote by mistake.  Code that catches everything and goes on evades it, and so does one
    long call into C.
    """
    left = steps

    def count(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        # A loop on one line is no new line each time round.
        frame.f_trace_opcodes = True
        left -= 1
        if left < 0:
            raise _TooLong
        return count

    tracing = sys.gettrace()
    sys.settrace(count)
    try:
        return call(*arguments)
    finally:
        sys.settrace(tracing)


def _forget(name: str, before: ModuleType | None) -> None:
    if before is None:
        sys.modules.pop(name, None)
    else:
        sys.modules[name] = before


def _named(make: Make, manifest: Manifest) -> Make:
    """``make`` whose things say under which name and version they were deployed."""

    def made(*arguments: object) -> Any:
        thing = make(*arguments)
        with suppress(AttributeError):  # what cannot be changed keeps the names that it has
            thing.name, thing.version = f"{PREFIX}{manifest.name}", manifest.label
        return thing

    return made


def _faults(kind: str, make: Make) -> Sequence[str]:
    """What a module lacks of its kind; empty where it conforms."""
    if kind == BEHAVIOUR:
        # To make one takes the parameters of a task.
        lacking = [name for name in ("look", "cost", "search", "hold", "execute") if not hasattr(make, name)]
        return [f"a behaviour has {name}" for name in lacking]
    strategy = make()
    lacking = [name for name in ("find", "improves", "merge") if not callable(getattr(strategy, name, None))]
    if lacking:
        return [f"a strategy has {name}" for name in lacking]
    faults = []
    if strategy.find([]).assigned_agent is not None:
        faults.append("find names somebody where nobody reported")
    found = strategy.find(list(REPORTS))
    if found.assigned_agent is not None and found.assigned_agent not in [report.agent for report in REPORTS]:
        faults.append("find names somebody who did not report")
    for order in (REPORTS[::-1], REPORTS[2:] + REPORTS[:2], REPORTS + REPORTS):
        if strategy.find(list(order)).assigned_agent != found.assigned_agent:
            faults.append("find depends on the order of the reports, or on how often it hears them")
            break
    halves = strategy.merge(strategy.merge(REPORTS[:2], ()), strategy.merge(REPORTS[2:], REPORTS[:2]))
    if strategy.find(list(halves)).assigned_agent != found.assigned_agent:
        faults.append("find of what merge keeps is not find of all reports")
    if strategy.improves(REPORTS[1], REPORTS[1], 0.1):
        faults.append("improves says that a report is better than itself")
    return faults
