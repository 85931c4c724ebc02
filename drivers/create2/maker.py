"""Maker: what the registry asks of the kind "create2"."""

from __future__ import annotations

from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.create2.driver import Create2Driver
from drivers.create2.option import checked, described
from drivers.deadman.keeper import kept
from drivers.link import Connector
from drivers.reading import Description
from drivers.serial import SerialConnector


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None) -> Create2Driver:
    """A driver of the robot at the end of the serial cable that ``options`` name."""
    if connector is not None:
        return Create2Driver(checked(options), name, connector, clock)
    return Create2Driver(checked(options), name, SerialConnector(), clock, kept(name))


def description(options: Mapping[str, object], name: str) -> Description:
    """What that robot is."""
    return described(checked(options))
