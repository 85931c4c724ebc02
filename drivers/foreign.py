"""Foreign: drivers of other distributions, found among the entry points of ``swarm_node.drivers`` or by their place.

Such a driver is a class, or whatever else can be called with (options, name, clock, connector).  It is foreign code,
and may fail in any way: that is told in one line which names it, and touches no other driver.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

from twisted.internet.task import Clock

from drivers.driver import Driver
from drivers.errors import DriverError, UsageError
from drivers.reading import Description

ENTRY_POINTS = "swarm_node.drivers"
NEEDED = ("description", "state", "connect", "disconnect", "enable", "disable", "act", "stop", "observe", "subscribe")

Make = Callable[[Mapping[str, object], str, Any, Any], Driver]


def places() -> dict[str, str]:
    """Each kind that other distributions bring, and its place, ``module:name``; none of them is imported."""
    from importlib.metadata import entry_points  # heavy, and most nodes never come here

    return {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}


def maker(kind: str, place: str) -> Make:
    """What makes drivers of ``kind``, out of ``place``; raises ``UsageError`` where it cannot be loaded."""
    module, _, attribute = place.partition(":")
    try:
        make = getattr(import_module(module), attribute)
    except Exception as error:  # a module of somebody else may fail in any way
        raise UsageError(f"driver {kind!r} cannot be loaded: {_told(error)}") from error
    if not callable(make):
        raise UsageError(f"driver {kind!r} cannot be loaded: {place} cannot be called")
    return partial(_made, kind, make)


def description_of(make: Make, options: Mapping[str, object], name: str) -> Description:
    """What such a robot is: a driver is made for that and thrown away, as making one opens nothing."""
    return make(options, name, Clock(), None).description


def _made(kind: str, make: Make, options: Mapping[str, object], name: str, clock: Any, connector: Any) -> Driver:
    try:
        driver = make(options, name, clock, connector)
        missing = [each for each in NEEDED if not hasattr(driver, each)]
        if missing or not isinstance(driver.description, Description):
            raise TypeError(f"it is no Driver: it lacks {', '.join(missing) or 'a Description'}")
    except DriverError:
        raise
    except Exception as error:  # foreign code
        raise UsageError(f"driver {kind!r} cannot be made with these options: {_told(error)}") from error
    return driver


def _told(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
