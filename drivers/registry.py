"""Find the driver of a kind of robot; a driver is imported only when its kind is used.

A kind is built in, an entry point of ``swarm_node.drivers``, or a class given as ``module:name``.  A driver that is not
built in is a class or another callable with the arguments (options, name, clock, connector).  Such a driver is
third-party code and may fail in any way. Its error is reported in one line that contains the name of the driver, and
does not affect the drivers of other kinds.
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

ENTRY_POINT_GROUP = "swarm_node.drivers"
REQUIRED_MEMBERS = (
    "description",
    "state",
    "connect",
    "disconnect",
    "enable",
    "disable",
    "act",
    "stop",
    "observe",
    "subscribe",
)
Factory = Callable[[Mapping[str, object], str, IReactorTime, "Connector | None"], Driver]
Describe = Callable[[Mapping[str, object], str], Description]
Parts = Sequence[tuple[str, Mapping[str, object]]]
"""The kind and the options of each sensing part of a robot."""


def list_built_in_kinds() -> list[str]:
    """Return the built-in kinds: the packages of ``drivers`` with a module ``driver``; the modules are not imported.

    Such a module has ``MANIFEST``, ``make_driver(options, name, clock, connector)`` and ``describe(options, name)``.
    """
    packages = [module.name for module in iter_modules(drivers.__path__) if module.ispkg]
    return [name for name in packages if find_spec(f"drivers.{name}.driver") is not None]


def load_manifest(kind: str) -> Manifest:
    """Return the manifest of a built-in kind; an empty manifest for any other kind."""
    return cast(Manifest, _load_attribute(kind, "MANIFEST")) if kind in list_built_in_kinds() else Manifest()


def list_kinds() -> list[str]:
    """Return the kinds of robot that have drivers, in all installed distributions, without importing the drivers."""
    return sorted({*list_built_in_kinds(), *list_entry_points()})


def list_entry_points() -> dict[str, str]:
    """Return each kind that another distribution provides, and its ``module:name``, without importing the module."""
    from importlib.metadata import entry_points  # expensive to import, and not needed by most nodes

    return {point.name: point.value for point in entry_points(group=ENTRY_POINT_GROUP)}


def load_factory(kind: str, place: str) -> Factory:
    """Load the factory of drivers of ``kind`` from ``place`` (``module:name``); raise ``UsageError`` if that fails."""
    module, _, attribute = place.partition(":")
    try:
        make = getattr(import_module(module), attribute)
    except Exception as error:  # a third-party module may fail in any way
        raise UsageError(f"driver {kind!r} cannot be loaded: {_one_line(error)}") from error
    if not callable(make):
        raise UsageError(f"driver {kind!r} cannot be loaded: {place} cannot be called")
    return partial(_make_checked, kind, make)


def get_description(make: Factory, options: Mapping[str, object], name: str) -> Description:
    """Return the description of a robot from a temporary driver, which ``make`` creates and which opens no links."""
    return make(options, name, Clock(), None).description


def create_driver(
    kind: str,
    options: Mapping[str, object],
    name: str,
    clock: IReactorTime,
    connector: Connector | None = None,
    parts: Parts = (),
) -> Driver:
    """Return an unconnected driver of ``kind``, combined with the sensors of ``parts``.

    ``name`` is the name of the device, and selects the robot if the options do not. ``connector`` opens the links
    (None: TCP on the running reactor). Raises ``UsageError`` with one line for an unknown kind or a wrong option.
    """
    main = cast(Factory, _load_attribute(kind, "make_driver"))(options, name, clock, connector)
    if not parts:
        return main
    from drivers.composite import combine_drivers  # not needed for a robot without parts

    part_drivers = []
    for number, (part, table) in enumerate(parts, 1):
        with _prefix_part_number(number):
            make_part = cast(Factory, _load_attribute(part, "make_driver"))
            part_drivers.append(make_part(table, f"{name}'s {part}", clock, connector))
    return combine_drivers(main, part_drivers, name)


def describe(kind: str, options: Mapping[str, object], name: str = "robot", parts: Parts = ()) -> Description:
    """Return the description of a robot of ``kind`` with ``parts``, without a driver; raises like ``create_driver``."""
    main = cast(Describe, _load_attribute(kind, "describe"))(options, name)
    if not parts:
        return main
    from drivers.composite import combine_descriptions

    descriptions = []
    for number, (part, table) in enumerate(parts, 1):
        with _prefix_part_number(number):
            descriptions.append(cast(Describe, _load_attribute(part, "describe"))(table, name))
    return combine_descriptions(main, descriptions)


@contextmanager
def _prefix_part_number(number: int) -> Iterator[None]:
    """Prefix errors with the number of the part."""
    try:
        yield
    except UsageError as error:
        raise UsageError(f"part {number}: {error}") from None


def _load_attribute(kind: str, attribute: str) -> object:
    if kind in list_built_in_kinds():
        return getattr(import_module(f"drivers.{kind}.driver"), attribute)
    place = kind if ":" in kind else list_entry_points().get(kind)
    if place is None:
        remedy = "for another driver write module:Class"
        raise UsageError(f"no driver for robots of kind {kind!r}; known are {', '.join(list_kinds())}; {remedy}")
    make = load_factory(kind, place)
    return make if attribute == "make_driver" else partial(get_description, make)


def _make_checked(
    kind: str, make: Factory, options: Mapping[str, object], name: str, clock: Any, connector: Any
) -> Driver:
    try:
        driver = make(options, name, clock, connector)
        missing = [each for each in REQUIRED_MEMBERS if not hasattr(driver, each)]
        if missing or not isinstance(driver.description, Description):
            raise TypeError(f"the result is not a Driver: it lacks {', '.join(missing) or 'a Description'}")
    except DriverError:
        raise
    except Exception as error:  # third-party code
        raise UsageError(f"driver {kind!r} cannot be made with these options: {_one_line(error)}") from error
    return driver


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
