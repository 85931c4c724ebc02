"""The real clock, network, store and control socket of nodes on this machine."""

from __future__ import annotations

import os
import random
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from twisted.application.service import IService, Service
from twisted.logger import Logger

from middleware.config.settings import IN_MEMORY, NodeSettings, Settings
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.data.store import Store
from middleware.entangled.network.interface import is_loopback
from middleware.entangled.network.network import ANY_HOST, Address, Network
from middleware.errors import BadSetting
from middleware.node import SwarmNode
from swarmnode.dependencies import Dependencies
from swarmnode.tunnels import add_tunnels

_log = Logger()


def make_dependencies(settings: Settings, reactor: Any) -> Dependencies:
    """Return the dependencies of a node on this machine."""
    membership = None
    if settings.node.membership:
        from middleware.admission.membership_file import MembershipFile

        membership = MembershipFile(Path(settings.node.membership))
    path = settings.node.store
    quota = settings.node.store_rows, settings.node.store_bytes
    rng = random.SystemRandom()
    store: Store
    if path == IN_MEMORY:
        store = MemoryStore(*quota, epoch=rng.randbytes(8))
    else:
        deliver, durable = reactor.callFromThread, settings.node.durable
        store = SqliteStore.open(Path(path), reactor.seconds(), *quota, deliver=deliver, durable=durable)
    lan = None
    if settings.node.lan and not is_loopback(settings.node.host):
        from middleware.entangled.network.lan import LanMulticast

        lan = partial(LanMulticast, reactor, settings.node.host)
    network = make_network_factory(settings.node, reactor, rng)
    shelf = None
    if settings.deployment.allow and path != IN_MEMORY:
        from middleware.deployment.module_store import FileModuleStore

        shelf = FileModuleStore(Path(f"{path}.deployed"))
    process = None
    if settings.faults.allow:
        from middleware.faults.process import OwnProcess

        process = OwnProcess()
    return Dependencies(
        reactor, network, store, rng, time.time, shelf=shelf, process=process, membership=membership, lan=lan
    )


def make_network_factory(node: NodeSettings, reactor: Any, rng: random.Random) -> Callable[[], Network]:
    """Return the factory of the node's network: its UDP port, and its tunnels if the settings have any."""
    from middleware.entangled.network.udp import UdpNetwork

    return add_tunnels(node, partial(UdpNetwork, reactor, node.host, node.port), reactor, rng, os.environ)


LookUp = Callable[..., Sequence[tuple[Any, ...]]]


def resolve_hosts(settings: Settings, look_up: LookUp = socket.getaddrinfo) -> Settings:
    """Replace each host name in ``settings`` by its address; raises ``BadSetting`` for an unknown name."""
    family = socket.AF_INET6 if ":" in settings.node.host else socket.AF_INET
    if settings.node.host == ANY_HOST:
        family = socket.AF_UNSPEC

    def figures(address: Address, key: str, family: int) -> Address:
        try:
            found = look_up(address.host, address.port, family=family, type=socket.SOCK_DGRAM)
            return Address(str(found[0][4][0]), address.port)
        except (OSError, UnicodeError, IndexError) as error:
            why = getattr(error, "strerror", None) or str(error)
            problem = f"no address is known for {address.host!r} ({why})"
            raise BadSetting(settings.origin, key, problem, "fix the name, or write a numeric address") from error

    known = tuple(figures(address, "[node] known_nodes", family) for address in settings.node.known_nodes)
    simulator = settings.web.yard
    if simulator is not None and "web" in settings.node.roles:
        simulator = figures(simulator, "[web] yard", socket.AF_UNSPEC)
    return replace(settings, node=replace(settings.node, known_nodes=known), web=replace(settings.web, yard=simulator))


def create_control_socket(settings: Settings, reactor: Any, node: SwarmNode) -> IService:
    """Return the control socket for ``swarm dht`` and similar commands; if it cannot be opened, log the reason."""
    from middleware.entangled.control.server import ControlServer
    from middleware.entangled.control.socket_path import NoControl, prepare_path

    def verbs() -> Any:
        from middleware.entangled.control.request_handler import RequestHandler
        from swarmnode.team.verb import TeamVerbs

        return TeamVerbs(RequestHandler.create(node.entangled, node.clock, node.rng), node)

    try:
        return ControlServer(reactor, prepare_path(settings.node.name), verbs)
    except NoControl as error:
        _log.warn("no control socket: {error}", error=error)
        return Service()
