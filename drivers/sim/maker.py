"""Maker: what the registry asks of the kind "sim"."""

from __future__ import annotations

from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.link import Connector, TcpConnector
from drivers.reading import Description
from drivers.sim.driver import SimDriver
from drivers.sim.option import Options, checked, described


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None) -> SimDriver:
    """A driver of the dog that ``options`` or else the device's ``name`` names."""
    return SimDriver(_named(options, name), TcpConnector(says=True) if connector is None else connector, clock)


def description(options: Mapping[str, object], name: str) -> Description:
    """What that dog is."""
    return described(_named(options, name))


def _named(options: Mapping[str, object], name: str) -> Options:
    return checked({"robot": name, **options})
