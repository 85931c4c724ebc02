"""Compile, run and check the source of a pushed module.

No other module executes pushed code.  This happens in the module's process, after its privileges were dropped, and in
the simulated counterpart of that process.  The caller has verified the signature.  The checks here detect mistakes:
source that cannot be parsed, raises an exception, or does not terminate.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType, ModuleType
from typing import Any, TypeVar

from middleware.consensus.deployed_modules import BEHAVIOUR, PREFIX, STRATEGY, Factory
from middleware.consensus.strategy import Report
from middleware.deployment.manifest import MAX_SOURCE_BYTES, Manifest, compute_digest
from middleware.errors import Undeployable

FACTORY_NAMES = {STRATEGY: "Strategy", BEHAVIOUR: "Behaviour"}
"""The name of the class, or other factory, that a module of each kind must define."""
MAX_STEPS = 500_000
"""Maximum number of Python instructions for the import and for each check: a fraction of a second."""
TEST_REPORTS = (Report("a" * 40, 2.0), Report("b" * 40, 1.0), Report("c" * 40, 1.0), Report("d" * 40, 3.5))

T = TypeVar("T")


class _TooManySteps(BaseException):
    """The code exceeded its number of steps; not an ``Exception``, so that a module does not catch it by accident."""


def load_module(manifest: Manifest, source: bytes) -> Factory:
    """Run the module's code, and return the factory of its strategy or behaviour.

    Raises ``Undeployable`` with the reason.
    """
    if len(source) != manifest.size or len(source) > MAX_SOURCE_BYTES or compute_digest(source) != manifest.digest:
        raise Undeployable(manifest.name, "the source does not match the signed digest and size")
    name = f"swarm_deployed_{manifest.name.replace('-', '_')}_{manifest.digest[:12]}"
    code = compile_source(source, name)
    module = ModuleType(name)
    before = sys.modules.get(name)
    # Some classes (such as dataclasses) look up their module.
    sys.modules[name] = module
    try:
        call_within(MAX_STEPS, exec, code, module.__dict__)
        make = getattr(module, FACTORY_NAMES[manifest.kind], None)
        if not callable(make):
            raise Undeployable(manifest.name, f"a {manifest.kind} has to define {FACTORY_NAMES[manifest.kind]}")
        faults = call_within(MAX_STEPS, _find_violations, manifest.kind, make)
        if faults:
            raise Undeployable(manifest.name, faults[0])
    except Undeployable:
        _restore_module(name, before)
        raise
    except _TooManySteps:
        _restore_module(name, before)
        raise Undeployable(manifest.name, f"takes more than {MAX_STEPS} steps to load") from None
    except BaseException as error:  # untrusted code; the node must survive any exception
        _restore_module(name, before)
        raise Undeployable(manifest.name, f"raises {type(error).__name__}: {error}") from error
    return _label_instances(make, manifest)


def compile_source(source: bytes, name: str) -> Any:
    """Compile a source; raises ``Undeployable`` with the line of a syntax error."""
    try:
        return compile(ast.parse(source, f"<{name}>"), f"<{name}>", "exec", dont_inherit=True)
    except SyntaxError as error:
        raise Undeployable(name, f"line {error.lineno or 0}: {error.msg}") from error
    except Exception as error:  # the parser raises other exceptions for crafted source (null bytes, deep nesting)
        raise Undeployable(name, f"is not Python: {error}") from error


def call_within(steps: int, call: Callable[..., T], *arguments: object) -> T:
    """Return the result of ``call`` if it takes at most ``steps`` Python instructions; otherwise raise.

    This stops accidental endless loops.  It does not stop code that catches every exception, nor a long call into C
    code.
    """
    left = steps

    def count(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        # A loop on a single line has no line events.
        frame.f_trace_opcodes = True
        left -= 1
        if left < 0:
            raise _TooManySteps
        return count

    tracing = sys.gettrace()
    sys.settrace(count)
    try:
        return call(*arguments)
    finally:
        sys.settrace(tracing)


def _restore_module(name: str, before: ModuleType | None) -> None:
    if before is None:
        sys.modules.pop(name, None)
    else:
        sys.modules[name] = before


def _label_instances(make: Factory, manifest: Manifest) -> Factory:
    """Wrap ``make`` so that its instances have the name and version under which they were deployed."""

    def make_labelled(*arguments: object) -> Any:
        instance = make(*arguments)
        with suppress(AttributeError):  # instances without these attributes keep theirs
            instance.name, instance.version = f"{PREFIX}{manifest.name}", manifest.label
        return instance

    return make_labelled


def _find_violations(kind: str, make: Factory) -> Sequence[str]:
    """Return the rules of the interface that the module violates."""
    if kind == BEHAVIOUR:
        # Creating a behaviour takes the parameters of a task.
        lacking = [name for name in ("look", "cost", "search", "hold", "execute") if not hasattr(make, name)]
        return [f"a behaviour has to define {name}" for name in lacking]
    strategy = make()
    lacking = [name for name in ("find", "improves", "merge") if not callable(getattr(strategy, name, None))]
    if lacking:
        return [f"a strategy has to define {name}" for name in lacking]
    faults = []
    if strategy.find([]).assigned_agent is not None:
        faults.append("find assigns an agent without any report")
    found = strategy.find(list(TEST_REPORTS))
    if found.assigned_agent is not None and found.assigned_agent not in [report.agent for report in TEST_REPORTS]:
        faults.append("find assigns an agent that did not report")
    for order in (TEST_REPORTS[::-1], TEST_REPORTS[2:] + TEST_REPORTS[:2], TEST_REPORTS + TEST_REPORTS):
        if strategy.find(list(order)).assigned_agent != found.assigned_agent:
            faults.append("find depends on the order of the reports or on duplicates")
            break
    halves = strategy.merge(strategy.merge(TEST_REPORTS[:2], ()), strategy.merge(TEST_REPORTS[2:], TEST_REPORTS[:2]))
    if strategy.find(list(halves)).assigned_agent != found.assigned_agent:
        faults.append("find after merge differs from find of all reports")
    if strategy.improves(TEST_REPORTS[1], TEST_REPORTS[1], 0.1):
        faults.append("improves says that a report is better than itself")
    return faults
