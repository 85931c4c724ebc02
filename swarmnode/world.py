"""World: the real clock, network, store, page and control socket, for nodes that run on this machine."""

from __future__ import annotations

import random
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from twisted.application.service import IService, MultiService, Service
from twisted.logger import Logger

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.sqlite import SqliteStore, read_records
from middleware.entangled.data.store import Store
from middleware.entangled.network.network import Address
from middleware.errors import BadSetting, MissingExtra
from middleware.node import SwarmNode
from middleware.settings import IN_MEMORY, Settings
from swarmnode.seams import Seams

_log = Logger()


def real_seams(settings: Settings, reactor: Any) -> Seams:
    """The seams of a node that runs on this machine."""
    from middleware.entangled.network.udp import UdpNetwork

    path = settings.node.store
    quota = settings.node.store_rows, settings.node.store_bytes
    rng = random.SystemRandom()
    store: Store
    if path == IN_MEMORY:
        store = MemoryStore(*quota, epoch=rng.randbytes(8))
    else:
        deliver, durable = reactor.callFromThread, settings.node.durable
        store = SqliteStore.open(Path(path), reactor.seconds(), *quota, deliver=deliver, durable=durable)
    network = partial(UdpNetwork, reactor, settings.node.host, settings.node.port)
    shelf = None
    if settings.deployment.allow and path != IN_MEMORY:
        from middleware.deployment.shelf import FileShelf

        shelf = FileShelf(Path(f"{path}.deployed"))
    return Seams(reactor, network, store, rng, time.time, shelf=shelf)


LookUp = Callable[..., Sequence[tuple[Any, ...]]]


def resolved(settings: Settings, look_up: LookUp = socket.getaddrinfo) -> Settings:
    """``settings`` with an address in figures for every host name; raises ``BadSetting`` for a name that has none."""
    family = socket.AF_INET6 if ":" in settings.node.host else socket.AF_INET

    def figures(address: Address, key: str, family: int) -> Address:
        try:
            found = look_up(address.host, address.port, family=family, type=socket.SOCK_DGRAM)
            return Address(str(found[0][4][0]), address.port)
        except (OSError, UnicodeError, IndexError) as error:
            why = getattr(error, "strerror", None) or str(error)
            problem = f"no address is known for {address.host!r} ({why})"
            raise BadSetting(settings.origin, key, problem, "mend the name, or write the address in figures") from error

    known = tuple(figures(address, "[node] known_nodes", family) for address in settings.node.known_nodes)
    yard = settings.web.yard
    if yard is not None and "web" in settings.node.roles:
        yard = figures(yard, "[web] yard", socket.AF_UNSPEC)
    return replace(settings, node=replace(settings.node, known_nodes=known), web=replace(settings.web, yard=yard))


class _Page(MultiService):
    """The page, and its line to the yard where there is one."""

    def __init__(self, web: Service, operator: Any) -> None:
        super().__init__()
        self._operator = operator
        web.setServiceParent(self)

    def startService(self) -> None:
        super().startService()
        if self._operator is not None:
            self._operator.connect().addErrback(lambda _: None)

    def stopService(self) -> Any:
        if self._operator is not None:
            self._operator.disconnect()
        return super().stopService()


def web_page(settings: Settings, seams: Seams, reactor: Any, node: SwarmNode) -> IService:
    """The web role: the page over the node's data store, live streams beside it; raises ``MissingExtra``."""
    from agents.catalogue import DEMO, TASKS

    try:
        from webnode.app import create_app
        from webnode.ledger import state_from
        from webnode.live import Events, Shots
        from webnode.server import Files, WebService, caller
        from webnode.state import Departed
        from webnode.team import TeamDesk
    except ModuleNotFoundError as error:
        raise MissingExtra("the web role", "web") from error
    from drivers.sim.link import TcpConnector
    from drivers.sim.operator import YardOperator

    yard = settings.web.yard
    operator = None if yard is None else YardOperator(TcpConnector(), reactor, yard.host, yard.port)
    desk = TeamDesk(node, TASKS, DEMO, operator)
    name = settings.node.name
    # A memory of the departed each: the file lags what is watched by a commit, and one would doubt the other.
    live = partial(state_from, desk.read, Departed(), name)
    on_file = partial(state_from, partial(read_records, Path(settings.node.store)), Departed(), name)
    stored = live if settings.node.store == IN_MEMORY else on_file
    app = create_app(lambda: stored(seams.wall()), desk, caller(reactor))
    events = Events(lambda: live(seams.wall()), reactor, seams.wall, desk.yard)
    web = WebService(reactor, settings.web.host, settings.web.port, app, events, Shots(desk, reactor), Files())
    return _Page(web, operator)


def control_socket(settings: Settings, reactor: Any, node: SwarmNode) -> IService:
    """The socket that ``swarm dht`` and its like speak to; where none can be made, the log says why."""
    from middleware.entangled.control.place import NoControl, made
    from middleware.entangled.control.port import ControlPort

    def verbs() -> Any:
        from middleware.entangled.control.verb import Verbs

        return Verbs.of(node.entangled, node.clock, node.rng)

    try:
        return ControlPort(reactor, made(settings.node.name), verbs)
    except NoControl as error:
        _log.warn("no control socket: {error}", error=error)
        return Service()
