"""Registry: the kind of a robot to its driver, imported only when that kind is asked for.

A kind is built in, an entry point of ``swarm_node.drivers``, or the place of a class, ``module:name``.  What is not
built in is a class, or whatever else can be called with (options, name, clock, connector).  It is foreign code, and
may fail in any way: that is told in one line which names it, and touches no other driver.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, cast

from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import Clock

import drivers
from drivers.driver import Driver
from drivers.errors import DriverError, UsageError
from drivers.option import Manifest
from drivers.reading import Description

if TYPE_CHECKING:
    from drivers.link import Connector

ENTRY_POINTS = "swarm_node.drivers"
NEEDED = ("description", "state", "connect", "disconnect", "enable", "disable", "act", "stop", "observe", "subscribe")
Factory = Callable[[Mapping[str, object], str, IReactorTime, "Connector | None"], Driver]
Describe = Callable[[Mapping[str, object], str], Description]
Parts = Sequence[tuple[str, Mapping[str, object]]]
"""Kind and options of each part that rides on a robot and only senses."""


def built_in_kinds() -> list[str]:
    """Return the kinds in the tree: the packages of ``drivers`` that have a ``driver`` module; none is imported.

    It has ``MANIFEST``, ``make_driver(options, name, clock, connector)`` and ``describe(options, name)``.
    """
    packages = [module.name for module in iter_modules(drivers.__path__) if module.ispkg]
    return [name for name in packages if find_spec(f"drivers.{name}.driver") is not None]


def manifest_of(kind: str) -> Manifest:
    """Return the manifest of a built-in kind; an empty one for any other."""
    return cast(Manifest, _found(kind, "MANIFEST")) if kind in built_in_kinds() else Manifest()


def kinds() -> list[str]:
    """The kinds of robot that there are drivers for, those of other distributions as well; none is imported."""
    return sorted({*built_in_kinds(), *places()})


def places() -> dict[str, str]:
    """Each kind that other distributions bring, and its place, ``module:name``; none of them is imported."""
    from importlib.metadata import entry_points  # heavy, and most nodes never come here

    return {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}


def maker(kind: str, place: str) -> Factory:
    """What makes drivers of ``kind``, out of ``place``; raises ``UsageError`` where it cannot be loaded."""
    module, _, attribute = place.partition(":")
    try:
        make = getattr(import_module(module), attribute)
    except Exception as error:  # a module of somebody else may fail in any way
        raise UsageError(f"driver {kind!r} cannot be loaded: {_told(error)}") from error
    if not callable(make):
        raise UsageError(f"driver {kind!r} cannot be loaded: {place} cannot be called")
    return partial(_made, kind, make)


def description_of(make: Factory, options: Mapping[str, object], name: str) -> Description:
    """What such a robot is: a driver is made for that and thrown away, as making one opens nothing."""
    return make(options, name, Clock(), None).description


def driver_for(
    kind: str,
    options: Mapping[str, object],
    name: str,
    clock: IReactorTime,
    connector: Connector | None = None,
    parts: Parts = (),
) -> Driver:
    """A driver of ``kind`` that is not connected yet, with the senses of ``parts``.

    ``name`` is the device's and says which robot is meant where the options do not; ``connector`` opens the
    links, real TCP on the running reactor where it is None.  Raises ``UsageError`` with one line for an unknown
    kind or a wrong option.
    """
    main = cast(Factory, _found(kind, "make_driver"))(options, name, clock, connector)
    if not parts:
        return main
    from drivers.joined import joined  # a robot without parts is spared it

    made = []
    for number, (part, table) in enumerate(parts, 1):
        with _naming(number):
            made.append(cast(Factory, _found(part, "make_driver"))(table, f"{name}'s {part}", clock, connector))
    return joined(main, made, name)


def describe(kind: str, options: Mapping[str, object], name: str = "robot", parts: Parts = ()) -> Description:
    """What a robot of ``kind`` with ``parts`` is, without making a driver; raises as ``driver_for`` does."""
    main = cast(Describe, _found(kind, "describe"))(options, name)
    if not parts:
        return main
    from drivers.joined import described

    made = []
    for number, (part, table) in enumerate(parts, 1):
        with _naming(number):
            made.append(cast(Describe, _found(part, "describe"))(table, name))
    return described(main, made)


@contextmanager
def _naming(number: int) -> Iterator[None]:
    """What is wrong with a part says with which."""
    try:
        yield
    except UsageError as error:
        raise UsageError(f"part {number}: {error}") from None


def _found(kind: str, attribute: str) -> object:
    if kind in built_in_kinds():
        return getattr(import_module(f"drivers.{kind}.driver"), attribute)
    place = kind if ":" in kind else places().get(kind)
    if place is None:
        remedy = "of your own: module:Class"
        raise UsageError(f"no driver for robots of kind {kind!r}; known are {', '.join(kinds())}; {remedy}")
    make = maker(kind, place)
    return make if attribute == "make_driver" else partial(description_of, make)


def _made(kind: str, make: Factory, options: Mapping[str, object], name: str, clock: Any, connector: Any) -> Driver:
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
