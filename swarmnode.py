"""The front door: builds the rooms from a node's settings and wires them; the only file that knows all.

``twistd -n swarm-node --config FILE`` runs a node (``Options``, ``makeService``); ``swarm`` is the command line (``main``);
``assembled`` wires one node over whatever clock, network and store it is given, real ones or those in memory.
"""

from __future__ import annotations

import importlib
import random
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from twisted.application.service import IService, Service
from twisted.internet.defer import Deferred, maybeDeferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger
from twisted.python import usage

from agents.catalogue import DEMO, TASKS
from agents.registry import agent_named
from drivers.driver import Driver
from drivers.errors import DriverError
from drivers.registry import describe, driver_for
from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Network
from middleware.entangled.sqlite import SqliteStore, read_records
from middleware.entangled.store import MemoryStore, Store
from middleware.errors import MissingExtra, SwarmError
from middleware.node import SwarmNode
from middleware.presence import Device
from middleware.settings import Settings

use_monotonic_time()

FAULTS = (SwarmError, EntangledError, DriverError)
"""What a person can mend, and is told in one line."""


@dataclass(frozen=True)
class Seams:
    """Where a node touches the world; everything else is logic.

    ``network`` makes the node's port each time that it enters the network; ``connector`` opens links to robots and yards
    (None: TCP); ``wall`` is unix time, for people.
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
        seed = rng.randbytes(32)
        store.note("identity", seed)
    return Identity(seed)


def assembled(settings: Settings, seams: Seams) -> Assembly:
    """Wire one node as ``settings`` say (thesis, Algorithm 4.1); raises ``SwarmError`` or ``DriverError`` where they cannot be met."""
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
    """One node of a team, with what its roles add; it can fall off the network for a while and come back."""

    _log = Logger()

    def __init__(self, settings: Settings, seams: Seams, web: Callable[[SwarmNode], IService] | None = None) -> None:
        self.settings = settings
        self._seams = seams
        self._web = web
        self._page: IService | None = None
        self.assembly = assembled(settings, seams)

    def startService(self) -> None:
        """Open the port and join; a port that cannot be had ends the program with one line."""
        super().startService()
        self._rise()

    def stopService(self) -> Deferred[None]:
        """Stop the robot, say goodbye, and close the store."""
        super().stopService()  # type: ignore[no-untyped-call]
        down = self._fall(self.assembly.node.stopService)
        if self._page is not None:
            down = down.addCallback(lambda _: maybeDeferred(self._page.stopService))  # type: ignore[union-attr]
        return down.addBoth(lambda _: self._seams.store.close())

    def vanish(self) -> None:
        """Stop at once and without a word, as when the power fails; the robot is left to its own dead-man timer."""
        self._fall(self.assembly.node.vanish)

    def leave(self, seconds: float) -> None:
        """Fall off the network, robot and all, and come back after ``seconds``."""
        self._log.info("{name} leaves the network for {s:g} s", name=self.settings.node.name, s=seconds)
        self._fall(self.assembly.node.vanish)
        self._seams.clock.callLater(seconds, self._return)

    def _return(self) -> None:
        if self.running:
            self.assembly = assembled(self.settings, self._seams)
            self._rise()

    def _rise(self) -> None:
        node, agent = self.assembly.node, self.assembly.agent
        node.on_disconnect(self.leave)
        node.startService()
        if agent is not None:
            agent.startService()
        if self._web is not None and self._page is None:
            self._page = self._web(node)
            self._page.startService()

    def _fall(self, part: Callable[[], None]) -> Deferred[Any]:
        agent = self.assembly.agent
        stopped = succeed(None) if agent is None or not agent.running else maybeDeferred(agent.stopService)
        part()
        return stopped


# -- the real world ---------------------------------------------------------------------------------------------------


def real_seams(settings: Settings, reactor: Any) -> Seams:
    """The seams of a node that runs on this machine."""
    from middleware.entangled.network.udp import UdpNetwork

    path = settings.node.store
    store: Store = MemoryStore() if path == ":memory:" else SqliteStore.open(Path(path), reactor.seconds())
    network = partial(UdpNetwork, reactor, settings.node.host, settings.node.port)
    return Seams(reactor, network, store, random.SystemRandom(), time.time)


def web_page(settings: Settings, seams: Seams, reactor: Any, node: SwarmNode) -> IService:
    """The web role: the page over the node's data store, live streams beside it."""
    try:
        from webnode.app import create_app
        from webnode.ledger import state_from
        from webnode.live import Events, Shots
        from webnode.server import Files, WebService, caller
        from webnode.state import Departed
        from webnode.team import TeamDesk
    except ImportError as error:
        raise MissingExtra("the web role", "web") from error
    from drivers.sim.link import TcpConnector
    from drivers.sim.operator import YardOperator

    yard = None
    if settings.web.yard:
        yard = YardOperator(TcpConnector(), reactor, settings.web.yard.host, settings.web.yard.port)
        yard.connect().addErrback(lambda _: None)
    desk = TeamDesk(node, TASKS, DEMO, yard)
    name = settings.node.name
    # A memory of the departed each: the file lags what is watched by a commit, and one would doubt the other.
    live = partial(state_from, desk.read, Departed(), name)
    on_file = partial(state_from, partial(read_records, Path(settings.node.store)), Departed(), name)
    stored = live if settings.node.store == ":memory:" else on_file
    app = create_app(lambda: stored(seams.wall()), desk, caller(reactor))
    events = Events(lambda: live(seams.wall()), reactor, seams.wall, desk.yard)
    return WebService(reactor, settings.web.host, settings.web.port, app, events, Shots(desk, reactor), Files())


# -- a team in memory -------------------------------------------------------------------------------------------------


class VirtualTeam:
    """A laptop, three dogs and their yard in one process, on one turned clock; a seed replays it exactly.

    What runs is what runs on a robot: the real node, agent, driver, yard and detection; only clock, wire and disk are in memory.
    """

    BOOTSTRAP = "vaio"
    DOGS = ("dog1", "dog2", "dog3")
    JOINING = 0.3

    def __init__(self, seed: int, camera_fps: float = 10.0, delay: float = 0.002, loss: float = 0.0) -> None:
        from middleware.entangled.clock import HeapClock
        from middleware.entangled.network.switchboard import Switchboard, Weather
        from sim.scene import loaded
        from sim.yard import Yard

        self.clock = HeapClock()
        weather = Weather(delay_s=delay, jitter_s=delay / 2, loss=loss)
        self.board = Switchboard(self.clock, random.Random(f"{seed}/board"), weather)
        self.yard = Yard(self.clock, random.Random(f"{seed}/yard"), loaded("three-dogs"))
        self.yard.start()
        self.services: dict[str, NodeService] = {}
        self._seed = seed
        self._fps = camera_fps
        for place, name in enumerate((self.BOOTSTRAP, *self.DOGS)):
            self._add(place, name)
            self.clock.advance(self.JOINING)
        self._open_desk()
        self.clock.advance(self.JOINING)

    def run_demo(self) -> str:
        """Press the Run Demo button; returns the task's id."""
        return self._desk.run_demo()

    def state(self) -> dict[str, Any]:
        """What the page shows now."""
        return self._state()

    def truth(self) -> dict[str, Any]:
        """Where everything in the yard really is."""
        return self.yard.world.snapshot()

    def scatter(self, seed: int) -> None:
        """Set the dogs down at random places."""
        self.yard.world.scatter(seed)

    def kill(self, name: str) -> None:
        """End a node as SIGKILL does: without a word to anybody."""
        self.services[name].vanish()

    def stop(self) -> None:
        """End everything."""
        for service in self.services.values():
            if service.running:
                service.stopService()
        self._operator.disconnect()
        self.yard.stop()

    def _add(self, place: int, name: str) -> None:
        port = 7000 + place
        mapping: dict[str, Any] = {"node": {"name": name, "port": port, "team_key": str(self._seed)}}
        if place:
            mapping["node"]["known_nodes"] = ["127.0.0.1:7000"]
            mapping["agent"] = {"module": "search"}
            mapping["driver"] = {"kind": "sim", "options": {"robot": name, "camera_fps": self._fps}}
        seams = Seams(
            self.clock,
            partial(self.board.network, "127.0.0.1", port),
            MemoryStore(),
            random.Random(f"{self._seed}/{name}"),
            self.clock.seconds,
            self.yard.connector(),
        )
        self.services[name] = NodeService(Settings.from_mapping(mapping, f"seed {self._seed}"), seams)
        self.services[name].startService()

    def _open_desk(self) -> None:
        from drivers.sim.operator import YardOperator
        from webnode.ledger import state_from
        from webnode.state import Departed
        from webnode.team import TeamDesk

        self._operator = YardOperator(self.yard.connector(), self.clock)
        self._operator.connect()
        self._desk = TeamDesk(self.services[self.BOOTSTRAP].assembly.node, TASKS, DEMO, self._operator)
        departed = Departed()
        self._state = lambda: state_from(self._desk.read, departed, self.BOOTSTRAP, self.clock.seconds())


# -- twistd -----------------------------------------------------------------------------------------------------------


class Options(usage.Options):
    """What ``twistd swarm-node`` takes; a flag wins over the file."""

    synopsis = "[--config FILE] [flags]"
    longdesc = "Run one node of a swarm: a peer of the network, the agent of a device, and the page if it has the web role."
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
            else:
                settings = Settings.from_mapping({"node": {"name": self["name"] or ""}}, "command line")
            self.settings = settings.with_flags(**flags)
        except SwarmError as error:
            _refuse(error)


def makeService(options: Options) -> IService:
    """The service that ``twistd`` runs."""
    from twisted.internet import reactor

    settings = options.settings
    try:
        seams = real_seams(settings, reactor)
        web = partial(web_page, settings, seams, reactor) if "web" in settings.node.roles else None
        return _Checked(settings, seams, web)
    except FAULTS as error:
        _refuse(f"{settings.origin}: {error}")


class _Checked(NodeService):
    """A node service whose failure to start is one line for a person and exit code 2."""

    def startService(self) -> None:
        try:
            super().startService()
        except FAULTS as error:
            _refuse(f"{self.settings.origin}: {error}")
        except Exception as error:
            if type(error).__name__ != "PortTaken":  # the page's own, not imported where there is no page
                raise
            _refuse(f"{self.settings.origin}: [web] port: {error}")


def _refuse(problem: object) -> NoReturn:
    sys.stderr.write(f"swarm-node: {problem}\n")
    raise SystemExit(2)


# -- swarm ------------------------------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    """The ``swarm`` command: ``swarm demo``, ``swarm yard``, ``swarm trials``."""
    words = sys.argv[1:] if arguments is None else arguments
    verbs: dict[str, tuple[str, str]] = {
        "demo": ("sim.demo", "three robots, a yard and the page, on this machine"),
        "yard": ("sim.server", "the yard alone"),
        "trials": ("sim.trials", "both experiments, many times"),
    }
    if not words or words[0] not in verbs:
        sys.stdout.write("usage: swarm VERB [options]\n\n" + "".join(f"  {v:8}{t[1]}\n" for v, t in verbs.items()))
        return 0 if words[:1] in ([], ["--help"], ["-h"]) else 2
    module = importlib.import_module(verbs[words[0]][0])
    if words[0] == "trials":
        return int(module.main(words[1:], VirtualTeam))
    return int(module.main(words[1:]) or 0)


if __name__ == "__main__":
    sys.exit(main())
