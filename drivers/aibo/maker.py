"""Maker: what the registry asks of the kind "aibo"."""

from __future__ import annotations

from collections.abc import Mapping

from twisted.internet.interfaces import IReactorTime

from drivers.aibo.driver import AiboDriver
from drivers.aibo.link import WAITS, UdpDatagrams
from drivers.aibo.option import checked, described
from drivers.deadman.keeper import kept
from drivers.link import Connector, TcpConnector
from drivers.reading import Description


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None) -> AiboDriver:
    """A driver of the dog at the host that ``options`` name."""
    return AiboDriver(
        checked(options),
        name,
        TcpConnector(waits=WAITS) if connector is None else connector,
        clock,
        UdpDatagrams(clock),
        kept(name) if connector is None else None,
    )


def description(options: Mapping[str, object], name: str) -> Description:
    """What that dog is."""
    return described(checked(options))
