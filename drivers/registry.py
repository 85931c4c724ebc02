"""Registry: the kind of a robot to its driver, imported only when that kind is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, cast

from twisted.internet.interfaces import IReactorTime

from drivers.driver import Driver
from drivers.errors import UsageError
from drivers.reading import Description

if TYPE_CHECKING:
    from drivers.sim.link import Connector

Factory = Callable[[Mapping[str, object], str, IReactorTime, "Connector | None"], Driver]
Describe = Callable[[Mapping[str, object], str], Description]

KINDS = {"phone": "drivers.phone.maker", "sim": "drivers.sim.maker"}
"""Kind to the module that has ``made(options, name, clock, connector)`` and ``description(options, name)``."""


def kinds() -> list[str]:
    """The kinds of robot that there are drivers for."""
    return sorted(KINDS)


def driver_for(
    kind: str,
    options: Mapping[str, object],
    name: str,
    clock: IReactorTime,
    connector: Connector | None = None,
) -> Driver:
    """A driver of ``kind`` that is not connected yet.

    ``name`` is the device's and says which robot is meant where the options do not; ``connector`` opens the
    links, real TCP on the running reactor where it is None.  Raises ``UsageError`` with one line for an unknown
    kind or a wrong option.
    """
    return cast(Factory, _found(kind, "made"))(options, name, clock, connector)


def describe(kind: str, options: Mapping[str, object], name: str = "robot") -> Description:
    """What a robot of ``kind`` is, without making a driver; raises as ``driver_for`` does."""
    return cast(Describe, _found(kind, "description"))(options, name)


def _found(kind: str, attribute: str) -> object:
    if kind not in KINDS:
        raise UsageError(f"no driver for robots of kind {kind!r}; known are {', '.join(kinds())}")
    return getattr(import_module(KINDS[kind]), attribute)
