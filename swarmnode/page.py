"""Page: the page of a web node, made of its parts: what it reads, the board, the streams, its ports.

Whoever imports this has the libraries of the extra ``web``.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twisted.application.service import MultiService
from twisted.internet.defer import gatherResults, maybeDeferred

from agents.catalogue import DEMO, TASKS
from drivers.link import TcpConnector
from drivers.sim.operator import YardOperator
from middleware.config.settings import IN_MEMORY, Settings
from middleware.entangled.data.sqlite import read_records
from middleware.frontend.client import TeamClient
from middleware.node import SwarmNode
from swarmnode.gateway import gateway
from swarmnode.invitation import at_terminal, invited
from swarmnode.seams import Seams
from webnode.app import create_app
from webnode.audit import audit
from webnode.board import Board, Phones
from webnode.chronicle import chronicle
from webnode.fallback import fallbacks
from webnode.faults import faults
from webnode.ground import Ground
from webnode.guard import LOCAL_ENDS
from webnode.halting import halts
from webnode.invite import TeamInvites
from webnode.ledger import Glance, state_from
from webnode.limits import limits
from webnode.live import Events, Shots
from webnode.server import Files, WebService, caller
from webnode.session import sessions
from webnode.state import Departed, State
from webnode.survey import survey
from webnode.team import TeamDesk

if TYPE_CHECKING:
    from webnode.tls import TlsDoor

Names = Callable[[], Sequence[str]]
Read = Callable[[float], State]
"""The team at a moment in unix seconds."""


class PageService(MultiService):
    """The page, its line to the yard where there is one, and what says where it is: to its user and to the team.

    ``phones`` take part through it, and leave with it.
    """

    def __init__(
        self, web: WebService, operator: YardOperator | None, tell: Callable[[], None], phones: Phones
    ) -> None:
        super().__init__()
        self._operator = operator
        self._phones = phones
        self._tell = tell
        web.setServiceParent(self)

    def startService(self) -> None:
        """Open its ports, say where it is, and reach for the yard."""
        super().startService()
        self._tell()
        if self._operator is not None:
            self._operator.connect().addErrback(lambda _: None)

    def stopService(self) -> Any:
        """Let the phones and the yard go and close its ports; fires when they are."""
        if self._operator is not None:
            self._operator.disconnect()
        left = self._phones.close()
        return gatherResults([left, maybeDeferred(super().stopService)])


def page(
    settings: Settings, seams: Seams, reactor: Any, node: SwarmNode, door: Callable[[Ground, Names], TlsDoor] | None
) -> PageService:
    """The page over the data store of ``node``; ``door`` makes its port over TLS, where it is to have one."""
    operator = _operator(settings, reactor)
    client = TeamClient(node)
    desk = TeamDesk(client, TASKS, DEMO, operator)
    ground = Ground(settings, node, client, desk, reactor, seams.wall, seams.rng)
    tls = None if door is None else door(ground, _names)

    def urls() -> list[str]:
        return web.urls(_names())

    hosts = hosts_of(settings, socket.gethostname())
    board = _board(ground, phones := gateway(ground), _invites(reactor, tls, urls))
    live = _live(ground)
    stored = live if settings.node.store == IN_MEMORY else _on_file(ground)
    glance = Glance(lambda: stored(seams.wall()), reactor.seconds)
    app = create_app(glance, board, caller(reactor), hosts, seams.wall)
    events, shots, address = _events(ground, board, live), Shots(desk, reactor), settings.web
    doors = [] if tls is None else [tls.open]
    parts = app, events, shots, Files(), board, seams.wall, hosts, doors
    web = WebService(reactor, address.host, address.port, *parts)

    def tell() -> None:
        where = address.host, lambda: web.port
        invited(settings.node.name, *where, board.sessions.code, web.secure_port, at_terminal())
        board.fallbacks.serves(urls())

    return PageService(web, operator, tell, phones)


def _operator(settings: Settings, reactor: Any) -> YardOperator | None:
    """The line to the yard that the page's map shows."""
    yard = settings.web.yard
    return None if yard is None else YardOperator(TcpConnector(), reactor, yard.host, yard.port)


def _invites(reactor: Any, tls: TlsDoor | None, urls: Callable[[], Sequence[str]]) -> TeamInvites:
    """Where the page is, and whom a browser has to trust there."""
    authority, fingerprint = (b"", "") if tls is None else (tls.signer.pem, tls.signer.fingerprint)
    return TeamInvites(urls, authority, fingerprint, reactor, reactor.getThreadPool())


def _board(ground: Ground, phones: Phones, invites: TeamInvites) -> Board:
    """What the page's routes act on."""
    team = fallbacks(ground)
    return Board(
        ground.desk,
        sessions(ground, team),
        audit(ground),
        chronicle(ground),
        team,
        limits(ground),
        survey(ground),
        halts(ground),
        faults(ground),
        phones,
        invites,
    )


def _live(ground: Ground) -> Read:
    """Reads what the node watches."""
    return partial(state_from, ground.desk.read, Departed(), ground.settings.node.name)


def _on_file(ground: Ground) -> Read:
    """Reads the file of the node's data store."""
    node = ground.settings.node
    # A memory of the departed of its own: the file lags what is watched by a commit, and one would doubt the other.
    return partial(state_from, partial(read_records, Path(node.store)), Departed(), node.name)


def _events(ground: Ground, board: Board, live: Read) -> Events:
    """The stream of what changes."""
    return Events(
        lambda: live(ground.wall()),
        ground.reactor,
        ground.wall,
        ground.desk.yard,
        board.fallbacks.here,
        board.chronicle,
        lambda: (ground.desk.version, tuple(ground.node.halt.stops)),
        board.sessions,
    )


def hosts_of(settings: Settings, machine: str) -> frozenset[str]:
    """The names by which a browser may open the page of this ``machine``, beside its addresses."""
    short = {machine.split(".")[0].lower(), settings.node.name.lower()}
    local = {f"{name}{end}" for name in short for end in ("", *LOCAL_ENDS)}
    return frozenset({machine.lower(), *local, *settings.web.names})


def _names() -> Sequence[str]:
    """What others in the network call this machine: its address, and its name where that is announced."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way:
        try:
            # Nothing is sent: the system says only from which of its addresses it would be.
            way.connect(("192.0.2.1", 9))
            address = str(way.getsockname()[0])
        except OSError:
            address = ""
    name = socket.gethostname().split(".")[0]
    return (address, f"{name}.local" if name not in ("", "localhost") else "", "" if address else "127.0.0.1")
