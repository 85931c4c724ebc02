"""Maker: what the registry asks of the kind "bittle"."""

from __future__ import annotations

from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.bittle.driver import BittleDriver
from drivers.bittle.link import HttpConnector
from drivers.bittle.option import checked, described
from drivers.deadman.keeper import kept
from drivers.link import Connector, TcpConnector
from drivers.reading import Description
from drivers.serial import SerialConnector


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None) -> BittleDriver:
    """A driver of the dog at the serial device or the address that ``options`` name."""
    checked_options = checked(options)
    dead_man = kept(name) if connector is None else None
    if checked_options.host:
        over = TcpConnector() if connector is None else connector
        return BittleDriver(checked_options, name, HttpConnector(over, clock, checked_options.board), clock, dead_man)
    return BittleDriver(checked_options, name, SerialConnector() if connector is None else connector, clock, dead_man)


def description(options: Mapping[str, object], name: str) -> Description:
    """What that dog is."""
    return described(checked(options))
