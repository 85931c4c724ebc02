"""The front door: builds the rooms from a node's settings and wires them.

``twistd -n swarm-node --config FILE`` runs a node (``Options``, ``makeService``); ``swarm`` is the command line
(``main``); ``assembled`` wires one node over whatever clock, network and store it is given, real ones or those in
memory (``rehearsal`` has a whole team of these).
"""

from __future__ import annotations

import ctypes
import gc
import random
import socket
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from twisted.application.service import IService, MultiService, Service
from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger, LoggingFile
from twisted.python import usage

from agents.registry import agent_named
from drivers.driver import Driver
from drivers.errors import DriverError
from drivers.registry import describe, driver_for
from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.errors import BadStore, EntangledError, PortInUse
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address, Network
from middleware.entangled.sqlite import SqliteStore, read_records
from middleware.entangled.store import MemoryStore, Store
from middleware.errors import BadSetting, MissingExtra, SwarmError, UnknownAgent
from middleware.node import SwarmNode
from middleware.presence import Device
from middleware.settings import COMMAND_LINE, IN_MEMORY, Settings
from webnode.errors import PortTaken, WebError

use_monotonic_time()

FAULTS = (SwarmError, EntangledError, DriverError, WebError)
"""What a person can mend, and is told in one line."""
KEYS: Sequence[tuple[type[Exception], str]] = (
    (PortInUse, "[node] port"),
    (BadStore, "[node] store"),
    (UnknownAgent, "[agent] module"),
    (DriverError, "[driver]"),
    (PortTaken, "[web] port"),
    (MissingExtra, "[node] roles"),
)
"""Which setting to look at for which fault."""
SETTLED = 3.0
"""Seconds after which a node has started and joined."""
COMING_BACK = 2.0
"""Seconds until a node that could not come back tries again."""


@dataclass(frozen=True)
class Seams:
    """Where a node touches the world; everything else is logic.

    ``network`` makes the node's port each time that it enters the network; ``connector`` opens links to robots and
    yards (None: TCP); ``wall`` is unix time, for people.
    """

    clock: IReactorTime
    network: Callable[[], Network]
    store: Store
    rng: random.Random
    wall: Callable[[], float]
    connector: Any = None


@dataclass
class Assembly:
    """One node with its agent and body, wired and not yet started."""

    node: SwarmNode
    agent: Service | None
    driver: Driver | None


def identity_in(store: Store, rng: random.Random) -> Identity:
    """The lasting identity that the store keeps, made at the first start."""
    seed = store.noted("identity")
    if seed is None or len(seed) != 32:
        if store.origin != "new":
            NodeService._log.warn("the data store has lost the node's identity: this node is a new one now")
        seed = rng.randbytes(32)
        store.note("identity", seed)
    return Identity(seed)


def assembled(settings: Settings, seams: Seams) -> Assembly:
    """Wire one node as ``settings`` say (thesis, Algorithm 4.1).

    Raises ``SwarmError`` or ``DriverError`` where they cannot be met.
    """
    node_settings, driver = settings.node, None
    capabilities = dict(node_settings.capabilities)
    kind = node_settings.kind
    if settings.driver.kind:
        body = describe(settings.driver.kind, settings.driver.options, node_settings.name)
        capabilities = {**body.capabilities, **capabilities}
        kind = kind if kind != "generic" else body.kind
        driver = driver_for(
            settings.driver.kind, settings.driver.options, node_settings.name, seams.clock, seams.connector
        )
    device = Device(
        uuid="",
        name=node_settings.name,
        kind=kind,
        description=node_settings.description,
        capabilities=capabilities,
        roles=tuple(node_settings.roles),
    )
    node = SwarmNode(
        device,
        identity_in(seams.store, seams.rng),
        node_settings.team_secret,
        list(node_settings.known_nodes),
        seams.network(),
        seams.store,
        seams.clock,
        seams.rng,
        seams.wall,
        node_settings.presence_lease,
    )
    agent = None
    if settings.agent.module and driver is not None:
        agent = agent_named(settings.agent.module)(node, driver, seams.clock, seams.rng)
    return Assembly(node, agent, driver)


class NodeService(Service):
    """One node of a team, with what its roles add; it can fall off the network for a while and come back.

    ``fronts`` make what people speak to of a node that runs, such as its page; they come and go with their node.
    """

    _log = Logger()

    def __init__(
        self, settings: Settings, seams: Seams, fronts: Sequence[Callable[[SwarmNode], IService]] = ()
    ) -> None:
        self.settings = settings
        self.assembly = assembled(settings, seams)
        self._seams = seams
        self._fronts = fronts
        self._open: list[IService] = []
        self._coming: IDelayedCall | None = None

    def startService(self) -> None:
        """Open the port and join; raises one of ``FAULTS`` where that cannot be."""
        super().startService()
        self._rise()

    def stopService(self) -> Deferred[None]:
        """Stop the robot, say goodbye, and close the store."""
        super().stopService()
        if self._coming is not None and self._coming.active():
            self._coming.cancel()
        ended = self._end_agent()
        self.assembly.node.stopService()
        down = gatherResults([ended, self._end_fronts()])
        return down.addBoth(lambda _: self._seams.store.close())

    def vanish(self) -> None:
        """Stop at once and without a word, as when the power fails; the robot's link breaks, too."""
        # The node first: afterwards the agent can tell nobody, not even that it gives its lease back.
        self.assembly.node.vanish()
        self._end_agent()
        self._end_fronts()

    def leave(self, seconds: float) -> None:
        """Fall off the network, robot and all, and come back after ``seconds``."""
        if self._coming is None and self.running:
            self._log.info("{name} leaves the network for {s:g} s", name=self.settings.node.name, s=seconds)
            self.vanish()
            self._coming = self._seams.clock.callLater(seconds, self._return)

    def _return(self) -> None:
        self._coming = None
        try:
            self.assembly = assembled(self.settings, self._seams)
            self._rise()
        except FAULTS as error:
            self._log.warn("{name} cannot come back yet: {error}", name=self.settings.node.name, error=error)
            self.vanish()
            self._coming = self._seams.clock.callLater(COMING_BACK, self._return)

    def _rise(self) -> None:
        node, agent = self.assembly.node, self.assembly.agent
        node.on_disconnect(self.leave)
        node.startService()
        if agent is not None:
            agent.startService()
        for front in self._fronts:
            self._open.append(front(node))
            self._open[-1].startService()

    def _end_agent(self) -> Deferred[object]:
        agent = self.assembly.agent
        return maybeDeferred(lambda: agent.stopService() if agent is not None and agent.running else None)

    def _end_fronts(self) -> Deferred[Any]:
        ended, self._open = self._open, []
        return gatherResults([maybeDeferred(front.stopService) for front in ended])


# -- the real world ---------------------------------------------------------------------------------------------------


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
    return Seams(reactor, network, store, rng, time.time)


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
        NodeService._log.warn("no control socket: {error}", error=error)
        return Service()


# -- twistd -----------------------------------------------------------------------------------------------------------


class Options(usage.Options):
    """What ``twistd swarm-node`` takes; a flag wins over the file."""

    synopsis = "[--config FILE] [flags]"
    longdesc = (
        "Run one node of a swarm: a peer of the network, the agent of a device, and the page if it has the web role."
    )
    optParameters = [
        ["config", "c", None, "TOML file of the node"],
        ["name", "n", None, "name of the node"],
        ["kind", "k", None, "kind of the device"],
        ["host", None, None, "address to listen on"],
        ["port", "p", None, "UDP port; 0 takes any"],
        ["known-nodes", None, None, "nodes to join through, as HOST:PORT,HOST:PORT"],
        ["store", "s", None, "path of the data store, or :memory:"],
        ["team-key", None, None, "the team's secret"],
        ["roles", "r", None, "of edge,bootstrap,web"],
        ["agent-module", "a", None, "agent of the device"],
        ["driver-kind", "d", None, "driver of its robot"],
        ["web-host", None, None, "address of the page"],
        ["web-port", None, None, "TCP port of the page"],
        ["web-yard", None, None, "yard that the page's map shows, as HOST:PORT"],
    ]
    settings: Settings

    def postOptions(self) -> None:
        """Read the file and the flags; what is wrong is said in one line, with exit code 2."""
        flags = {name.replace("-", "_"): value for name, value in self.items() if name != "config"}
        try:
            if self["config"]:
                settings = Settings.load(self["config"])
            elif self["name"] is None:
                raise BadSetting(COMMAND_LINE, "--name", "is missing", "say --name NAME, or --config FILE")
            else:
                settings = Settings.from_mapping({"node": {"name": "unnamed"}}, COMMAND_LINE)
            self.settings = settings.with_flags(**flags)
        except SwarmError as error:
            _refuse(error)


def makeService(options: Options) -> IService:
    """The service that ``twistd`` runs."""
    from twisted.internet import reactor

    settings = options.settings
    try:
        settings = resolved(settings)
        seams = real_seams(settings, reactor)
        fronts: list[Callable[[SwarmNode], IService]] = [partial(control_socket, settings, reactor)]
        if "web" in settings.node.roles:
            fronts.append(partial(web_page, settings, seams, reactor))
        reactor.callLater(SETTLED, _give_back)
        return _Checked(settings, seams, fronts)
    except FAULTS as error:
        _refuse(told(error, settings.origin))


def _give_back() -> None:
    """Hand back what only starting needed: glibc keeps it for later, and a small device has other uses for it."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


class _Checked(NodeService):
    """A node service whose failure to start is one line for a person and exit code 2."""

    def startService(self) -> None:
        try:
            super().startService()
        except FAULTS as error:
            _refuse(told(error, self.settings.origin))


def told(error: Exception, origin: str) -> str:
    """One line that says in which file, at which key, what is wrong and what to do."""
    if isinstance(error, BadSetting):
        return str(error)
    key = next((key for kind, key in KEYS if isinstance(error, kind)), "")
    return " ".join(": ".join(filter(None, (origin, key, str(error)))).split())


def _refuse(problem: object) -> NoReturn:
    # Once twistd logs, what is written to sys.stderr ends up in the log and not before the person's eyes.
    stream = sys.__stderr__ if isinstance(sys.stderr, LoggingFile) else sys.stderr
    if stream is not None:
        stream.write(f"swarm-node: {problem}\n")
    raise SystemExit(2)
