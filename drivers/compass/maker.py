"""Maker: what the registry asks of the kind "compass"."""

from __future__ import annotations

from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.compass.driver import CompassDriver
from drivers.compass.option import checked, described
from drivers.link import Connector, TcpConnector
from drivers.reading import Description


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None) -> CompassDriver:
    """A driver of the compass that ``options`` name."""
    wanted = checked(options)
    if connector is None and wanted.device:
        from drivers.serial import SerialConnector  # a compass on the network is spared it

        connector = SerialConnector()
    return CompassDriver(wanted, name, TcpConnector(says=True) if connector is None else connector, clock)


def description(options: Mapping[str, object], name: str) -> Description:
    """What that compass is."""
    return described(checked(options))
