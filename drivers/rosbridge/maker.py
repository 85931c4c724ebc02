"""Maker: what the registry asks of the kind "rosbridge"."""

from __future__ import annotations

from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.deadman.keeper import kept
from drivers.link import Connector, TcpConnector
from drivers.reading import Description
from drivers.rosbridge.driver import RosbridgeDriver
from drivers.rosbridge.option import checked, described


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None) -> RosbridgeDriver:
    """A driver of the robot behind the rosbridge that ``options`` names."""
    if connector is not None:
        return RosbridgeDriver(checked(options), connector, clock, name)
    return RosbridgeDriver(checked(options), TcpConnector(says=True), clock, name, dead_man=kept(name))


def description(options: Mapping[str, object], name: str) -> Description:
    """What that robot is."""
    return described(checked(options))
