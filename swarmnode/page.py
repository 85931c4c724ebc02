"""Composition of a web node's page: data sources, API and ports.

Importing this module requires the libraries of the extra ``web``.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twisted.application.service import MultiService
from twisted.internet.defer import gatherResults, maybeDeferred

from agents.catalogue import DEMO_TASK, TASKS
from drivers.link import TcpConnector
from drivers.sim.client import SimulatorClient
from middleware.config.settings import IN_MEMORY, Settings
from middleware.entangled.data.sqlite import read_records
from middleware.frontend.client import TeamClient
from middleware.node import SwarmNode
from swarmnode.dependencies import Dependencies
from swarmnode.gateway import make_gateway
from swarmnode.page_access import announce_page, find_terminal
from webnode.audit import AuditLog
from webnode.diagnostics import Diagnostics
from webnode.failover import TeamFallbacks
from webnode.faults import FaultControl
from webnode.invite import Invites
from webnode.request_guard import LOCAL_SUFFIXES
from webnode.server import WebService
from webnode.services import Phones, Services
from webnode.session import make_sessions
from webnode.state import DepartedDevices
from webnode.state_builder import StateCache, build_state
from webnode.stop_control import StopControl
from webnode.team_control import TeamControl

if TYPE_CHECKING:
    from webnode.tls import TlsPort


class PageService(MultiService):
    """The page's service, with a connection to the robot simulator if there is one.

    ``tell`` announces the page to its user and to the team.  ``phones`` take part through the page and stop with it.
    """

    def __init__(
        self, web: WebService, simulator: SimulatorClient | None, tell: Callable[[], None], phones: Phones
    ) -> None:
        super().__init__()
        self._operator = simulator
        self._phones = phones
        self._announce = tell
        web.setServiceParent(self)

    def startService(self) -> None:
        """Open the ports, announce the page, and connect to the simulator."""
        super().startService()
        self._announce()
        if self._operator is not None:
            self._operator.connect().addErrback(lambda _: None)

    def stopService(self) -> Any:
        """Stop the phones, disconnect from the simulator, and close the ports; fires when done."""
        if self._operator is not None:
            self._operator.disconnect()
        left = self._phones.close()
        return gatherResults([left, maybeDeferred(super().stopService)])


def make_page_service(
    settings: Settings,
    dependencies: Dependencies,
    reactor: Any,
    node: SwarmNode,
    make_tls_port: Callable[..., TlsPort] | None,
) -> PageService:
    """Return the page that shows the data store of ``node``; ``make_tls_port`` creates its TLS port (None: no TLS)."""
    address, wall, store = settings.web, dependencies.wall, settings.node.store
    simulator = None
    if address.yard is not None:
        simulator = SimulatorClient(TcpConnector(), reactor, address.yard.host, address.yard.port)
    client = TeamClient(node)
    control = TeamControl(client, TASKS, DEMO_TASK, simulator)
    tls = (
        None
        if make_tls_port is None
        else make_tls_port(settings, node.store, reactor, wall, dependencies.rng, _list_machine_names)
    )
    team = TeamFallbacks(node, reactor.seconds)
    phones = make_gateway(settings, node, dependencies, reactor, client.view)

    def urls() -> list[str]:
        return web.urls(_list_machine_names())

    authority, fingerprint = (b"", "") if tls is None else (tls.signer.pem, tls.signer.fingerprint)
    services = Services(
        control,
        make_sessions(settings, node, reactor, dependencies.rng, team),
        AuditLog(None if store == IN_MEMORY else Path(f"{store}.audit"), wall),
        fallbacks=team,
        diagnostics=Diagnostics(node, client),
        stop_control=StopControl(client),
        faults=FaultControl(node, reactor.seconds) if settings.faults.allow else None,
        phones=phones,
        invites=Invites(urls, authority, fingerprint, reactor, reactor.getThreadPool()),
    )
    live = partial(build_state, client.read, DepartedDevices(), settings.node.name)
    # Each source has its own list of departed devices, because the file is one commit behind the watched records.
    on_file = partial(build_state, partial(read_records, Path(store)), DepartedDevices(), settings.node.name)
    stored = live if store == IN_MEMORY else on_file
    web = WebService(
        reactor,
        address.host,
        address.port,
        StateCache(lambda: stored(wall()), reactor.seconds),
        services,
        wall,
        list_host_names(settings, socket.gethostname()),
        [] if tls is None else [tls.open],
        live=lambda: live(wall()),
        version=lambda: (client.version, tuple(node.stop_state.stops)),
    )

    def tell() -> None:
        where = address.host, lambda: web.port
        announce_page(settings.node.name, *where, services.sessions.code, web.secure_port, find_terminal())
        team.publish(urls())

    return PageService(web, simulator, tell, phones)


def list_host_names(settings: Settings, machine: str) -> frozenset[str]:
    """Return the host names by which a browser may open the page, in addition to addresses."""
    short = {machine.split(".")[0].lower(), settings.node.name.lower()}
    local = {f"{name}{end}" for name in short for end in ("", *LOCAL_SUFFIXES)}
    return frozenset({machine.lower(), *local, *settings.web.names})


def _list_machine_names() -> Sequence[str]:
    """Return the names of this machine in the network: its address, and its mDNS name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Sends nothing: connect only selects the source address.
            probe.connect(("192.0.2.1", 9))
            address = str(probe.getsockname()[0])
        except OSError:
            address = ""
    name = socket.gethostname().split(".")[0]
    return (address, f"{name}.local" if name not in ("", "localhost") else "", "" if address else "127.0.0.1")
