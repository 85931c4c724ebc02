"""Web: the page of a node that has the role, over the node's data store, with live streams beside it."""

from __future__ import annotations

import random
import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twisted.application.service import IService, MultiService, Service
from twisted.internet.defer import gatherResults, maybeDeferred

from middleware.entangled.data.sqlite import read_records
from middleware.errors import BadSetting, MissingExtra
from middleware.node import SwarmNode
from middleware.settings import IN_MEMORY, Settings
from swarmnode.invitation import invited
from swarmnode.seams import Seams

if TYPE_CHECKING:
    from webnode.board import Phones


class _Page(MultiService):
    """The page, its line to the yard where there is one, and what says where it is: to its user and to the team.

    ``phones`` take part through it, and leave with it.
    """

    def __init__(self, web: Service, operator: Any, tell: Callable[[], None], phones: Phones) -> None:
        super().__init__()
        self._operator = operator
        self._phones = phones
        self._tell = tell
        web.setServiceParent(self)

    def startService(self) -> None:
        super().startService()
        self._tell()
        if self._operator is not None:
            self._operator.connect().addErrback(lambda _: None)

    def stopService(self) -> Any:
        if self._operator is not None:
            self._operator.disconnect()
        left = self._phones.close()
        return gatherResults([left, maybeDeferred(super().stopService)])


def with_code(settings: Settings, rng: random.Random) -> Settings:
    """``settings`` with a code to sign in with: made once, as a node that falls off the network comes back with it."""
    from webnode.session import made

    web = settings.web
    return settings if web.code or not web.sign_in else replace(settings, web=replace(web, code=made(rng)))


def web_page(settings: Settings, seams: Seams, reactor: Any, node: SwarmNode) -> IService:
    """The web role: the page over the node's data store, live streams beside it; raises ``MissingExtra``."""
    from agents.catalogue import DEMO, TASKS

    try:
        from swarmnode.gateway import gateway
        from webnode.app import create_app
        from webnode.audit import audit
        from webnode.board import Board
        from webnode.chronicle import chronicle
        from webnode.fallback import fallbacks
        from webnode.ground import Ground
        from webnode.halting import halts
        from webnode.invite import TeamInvites
        from webnode.ledger import Glance, state_from
        from webnode.limits import limits
        from webnode.live import Events, Shots
        from webnode.mischief import faults
        from webnode.server import Files, WebService, caller
        from webnode.session import sessions
        from webnode.state import Departed
        from webnode.survey import survey
        from webnode.team import TeamDesk
        from webnode.tuner import tuning
    except ModuleNotFoundError as error:
        raise MissingExtra("the web role", "web") from error
    door = _doorway(settings) if settings.web.tls else None
    from drivers.sim.link import TcpConnector
    from drivers.sim.operator import YardOperator

    yard = settings.web.yard
    operator = None if yard is None else YardOperator(TcpConnector(), reactor, yard.host, yard.port)
    desk = TeamDesk(node, TASKS, DEMO, operator)
    ground = Ground(settings, node, desk, reactor, seams.wall, seams.rng)
    tls = None if door is None else door(ground, _names)
    invites = TeamInvites(
        lambda: web.urls(_names()),
        b"" if tls is None else tls.signer.pem,
        "" if tls is None else tls.signer.fingerprint,
        reactor,
        reactor.getThreadPool(),
    )
    board = Board(
        desk,
        sessions(ground),
        audit(ground),
        chronicle(ground),
        fallbacks(ground),
        limits(ground),
        survey(ground),
        tuning(ground),
        halts(ground),
        faults(ground),
        phones := gateway(ground),
        invites,
    )
    name = settings.node.name
    # A memory of the departed each: the file lags what is watched by a commit, and one would doubt the other.
    live = partial(state_from, desk.read, Departed(), name)
    on_file = partial(state_from, partial(read_records, Path(settings.node.store)), Departed(), name)
    stored = live if settings.node.store == IN_MEMORY else on_file
    app = create_app(Glance(lambda: stored(seams.wall()), reactor.seconds), board, caller(reactor), wall=seams.wall)
    events = Events(
        lambda: live(seams.wall()),
        reactor,
        seams.wall,
        desk.yard,
        board.fallbacks.here,
        board.chronicle,
        lambda: (desk.version, board.halts is not None and board.halts.is_halted()),
        board.sessions,
    )
    shots, address = Shots(desk, reactor), settings.web
    doors = [] if tls is None else [tls.open]
    web = WebService(reactor, address.host, address.port, app, events, shots, Files(), board, seams.wall, doors=doors)

    def tell() -> None:
        invited(name, address.host, lambda: web.port, board.sessions.code, web.secure_port)
        board.fallbacks.serves(web.urls(_names()))

    return _Page(web, operator, tell, phones)


def _doorway(settings: Settings) -> Callable[..., Any]:
    """What makes the page's port over TLS; raises ``BadSetting`` where its libraries are missing."""
    try:
        from webnode.tls import door
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        problem = f"is {settings.web.tls!r}, and the library {library} is not installed"
        remedy = "install it by: pip install 'swarm-node[tls]', or leave tls out"
        raise BadSetting(settings.origin, "[web] tls", problem, remedy) from error
    return door


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
