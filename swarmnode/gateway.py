"""Gateway: the way of phones into the team, through the node that serves the page.

Each phone is a node of its own, with identity, port, agent and a driver that is handed what the phone sees.  Its
identity follows from a secret of the phone and from the team, so it is the same device at every web node.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred, DeferredList, fail, maybeDeferred, succeed
from twisted.internet.interfaces import IDelayedCall
from twisted.logger import Logger

from drivers.phone.driver import SIGHT, PhoneDriver
from drivers.phone.option import FPS, MOST_SIDE
from formats.jpeg import size_of
from middleware.admission.certificate import GATEWAY
from middleware.config.settings import (
    IN_MEMORY,
    AgentSettings,
    DeploymentSettings,
    DriverSettings,
    FaultSettings,
    Settings,
    WebSettings,
)
from middleware.directory.presence import DONE, EXECUTING, IDLE, Device
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import Identity
from middleware.entangled.token_bucket import TokenBucket
from middleware.frontend.view import TeamView
from middleware.node import SwarmNode
from swarmnode.assembly import FAULTS, assembled
from swarmnode.seams import Seams
from webnode.board import Wanted
from webnode.errors import Refusal

MOST = 8
"""Phones at one web node: each costs it the memory and the work of a node."""
SILENCE_S = 1.0
"""A phone that says nothing for so long has left."""
FIRST_S = 5.0
"""It has so long until its first look: its visitor may be asked for the camera once more."""
IDLE_FPS = 5.0
"""Pictures a second while it has no task: enough not to look gone, and it spares the battery."""
LOOKS, LOOKS_S = 20.0, 15.0
"""So many looks at once, and so many a second."""
JOINS, JOINS_S = 8.0, 1.0
PLACE_S = 1.0
"""Where the phone is is told to the others at most so often."""
PLACE: Mapping[str, int] = {"lat": 5, "lon": 5, "accuracy": 0}
"""What is told of it, to so many decimals: a metre."""
PERSON = b"phone"


def seed_of(team: bytes, secret: bytes) -> bytes:
    """The seed of a phone's identity, by its own ``secret``; another one in each team, which ``team`` names."""
    return hashlib.blake2s(secret, key=team, person=PERSON).digest()


def sides(jpeg: bytes) -> tuple[int, int]:
    """Width and height in pixels of a phone's picture; raises ``Refusal`` 400 for what is none that is used here."""
    size = size_of(jpeg)
    if size is None or max(size) > MOST_SIDE:
        problem = "it is no JPEG picture that is used here" if jpeg else "it is missing or empty"
        raise Refusal("body", problem, f"send a whole JPEG of at most {MOST_SIDE} pixels a side")
    return size


class Gateway:
    """The phones that take part through ``node``.

    ``seams`` makes the seams of one more node; ``others`` are the devices that are here.  A phone that leaves, or falls
    silent, gives back what it holds: this node still speaks for it, so another goes on at once.
    """

    _log = Logger()

    def __init__(
        self, settings: Settings, node: SwarmNode, seams: Callable[[], Seams], others: Callable[[], Sequence[Device]]
    ) -> None:
        self._settings = settings
        self._node = node
        self._seams = seams
        self._others = others
        self._phones: dict[str, _Phone] = {}
        self._ending: dict[str, Deferred[Any]] = {}
        self._away: dict[str, float] = {}
        self._joins = TokenBucket(JOINS_S, JOINS)

    def join(self, secret: bytes, name: str, can: Mapping[str, Any]) -> Deferred[str]:
        """Let a phone take part; fires with its uuid, fails with ``Refusal`` 409, 429 or 503."""
        closed = self._node.team
        seed = seed_of(self._settings.node.team_secret if closed is None else closed.roll.operator, secret)
        uuid = Identity(seed).node_id.hex()
        if uuid in self._phones:
            self._phones[uuid].wait(FIRST_S)
            return succeed(uuid)
        now = self._node.clock.seconds()
        sent_away = self._away.get(uuid, now) - now
        if sent_away > 0.0:
            return fail(Refusal("phone", "an operator sent it away", f"wait {sent_away:.0f} s", 409))
        if len(self._phones) >= MOST:
            remedy = "wait until one leaves, or join at another web node"
            return fail(Refusal("phone", f"{MOST} phones take part at this node", remedy, 409))
        team = self._node.team
        if team is not None and GATEWAY not in team.door.me.roles:
            remedy = f"have the operator say: swarm promote {team.door.me.name} --role {GATEWAY}"
            return fail(Refusal("phone", "this node may not bring guests into its team", remedy, 409))
        if not self._joins.take(now):
            return fail(Refusal("phone", "too many join at once", "try again in a few seconds", 429))
        joined: Deferred[str] = Deferred()

        def enter(left: Any) -> Any:
            try:
                if uuid not in self._phones:
                    self._phones[uuid] = self._made(uuid, seed, self._free(name, uuid), can)
                joined.callback(uuid)
            except FAULTS as error:
                joined.errback(Refusal("phone", f"it cannot take part: {error}", "try again in a moment", 503))
            return left

        # A phone that comes back while it still says goodbye would be there twice.
        self._ending.get(uuid, succeed(None)).addCallback(enter)
        return joined

    def look(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> Wanted:
        """Take what a phone sees and measures; raises ``Refusal`` 400, 404 or 429."""
        size = sides(jpeg)
        phone = self._phones.get(uuid)
        if phone is None:
            raise Refusal("uuid", "this phone takes no part here", "join by POST /api/v1/phones", 404)
        phone.wait(SILENCE_S)
        if not phone.bucket.take(self._node.clock.seconds()):
            raise Refusal("phone", "it looks too often", f"send at most {FPS:g} looks a second", 429)
        return phone.look(jpeg, size, values)

    def leave(self, uuid: str) -> None:
        """Let a phone go; one that is not here has gone already."""
        phone = self._phones.pop(uuid, None)
        if phone is None:
            return

        def gone(_: object) -> None:
            self._ending.pop(uuid, None)

        ending = self._ending[uuid] = phone.stop()
        ending.addBoth(gone)

    def close(self) -> Deferred[Any]:
        """Let all of them go; fires when they have."""
        for uuid in list(self._phones):
            self.leave(uuid)
        waiting = [ending.addCallback(lambda _: None) for ending in self._ending.values()]
        return DeferredList(waiting, consumeErrors=True)

    def _made(self, uuid: str, seed: bytes, name: str, can: Mapping[str, Any]) -> _Phone:
        seams = self._seams()
        seams.store.note("identity", seed)
        if self._node.team is not None:
            from middleware.admission.membership import MemoryMembership

            seams = replace(seams, membership=MemoryMembership(self._node.team.guest(seed, name)))
        settings = _settings_of(self._settings, self._node, name, can)
        assembly = assembled(settings, seams)
        assert isinstance(assembly.driver, PhoneDriver) and assembly.agent is not None
        phone = _Phone(assembly.node, assembly.agent, assembly.driver, partial(self._silent, uuid))
        assembly.node.on_disconnect(partial(self._sent_away, uuid))
        phone.start()
        return phone

    def _free(self, name: str, uuid: str) -> str:
        """``name``, or where another device has it one like it that none has."""
        taken = {device.name for device in self._others() if device.uuid != uuid}
        taken |= {phone.name for other, phone in self._phones.items() if other != uuid}
        return name if name not in taken else f"{name[:35]}-{uuid[:4]}"

    def _silent(self, uuid: str) -> None:
        self._log.info("{name} says nothing any more", name=self._phones[uuid].name)
        self.leave(uuid)

    def _sent_away(self, uuid: str, seconds: float) -> None:
        now = self._node.clock.seconds()
        self._away = {other: until for other, until in self._away.items() if until > now}
        self._away[uuid] = now + seconds
        self.leave(uuid)


class _Phone:
    """One phone: its node, its agent, and its driver; ``silent`` is called when it says nothing any more."""

    def __init__(self, node: SwarmNode, agent: Service, driver: PhoneDriver, silent: Callable[[], None]) -> None:
        self.name = node.presence.device.name
        self.bucket = TokenBucket(LOOKS_S, LOOKS)
        self._node = node
        self._agent = agent
        self._driver = driver
        self._silent = silent
        self._timer: IDelayedCall | None = None
        self._placed_at = 0.0

    def start(self) -> None:
        """Open the port and join; raises one of ``FAULTS`` where that cannot be."""
        self._node.startService()
        self._agent.startService()
        self.wait(FIRST_S)

    def stop(self) -> Deferred[Any]:
        """Give back what it holds, then say goodbye."""
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        return maybeDeferred(self._agent.stopService).addBoth(lambda _: self._node.stopService())

    def wait(self, seconds: float) -> None:
        """Expect something of it within so long."""
        if self._timer is not None and self._timer.active():
            self._timer.reset(seconds)
        else:
            self._timer = self._node.clock.callLater(seconds, self._silent)

    def look(self, jpeg: bytes, size: tuple[int, int], values: Mapping[str, float]) -> Wanted:
        """Hand on what it sees, and say what is wanted of it."""
        self._driver.look(jpeg, *size, values)
        now = self._node.clock.seconds()
        place = {key: round(values[f"position.{key}"], n) for key, n in PLACE.items() if f"position.{key}" in values}
        if place and now - self._placed_at >= PLACE_S:
            self._placed_at = now
            self._node.presence.change(position=place)
        device = self._node.presence.device
        return Wanted(FPS if device.task else IDLE_FPS, self._words(device, SIGHT[0] in values))

    def _words(self, device: Device, is_seen: bool) -> str:
        """What whoever holds it is asked to do."""
        if self._node.halt.is_stopped:
            return "The team is stopped. Wait."
        if device.status == EXECUTING:
            return (
                "You have the task: keep the target in view."
                if is_seen
                else "You have the task, and the target is out of sight: turn until you see it."
            )
        if device.status == DONE:
            return "Done. Thank you."
        if device.status == IDLE or not device.task:
            return "Nothing to do at the moment."
        return (
            "You see it. Keep it in view, ready to take over." if is_seen else "Look for the red target: turn slowly."
        )


def _settings_of(settings: Settings, node: SwarmNode, name: str, can: Mapping[str, Any]) -> Settings:
    """Those of a phone: it joins through the node that it comes by, and nobody makes it fail or pushes code to it."""
    known = (node.entangled.contact.address, *settings.node.known_nodes)
    of_node = replace(
        settings.node,
        name=name,
        kind="phone",
        description=f"A visitor's phone, through {settings.node.name}",
        port=0,
        known_nodes=known,
        store=IN_MEMORY,
        roles=("edge",),
        capabilities={},
        position={},
    )
    driver = DriverSettings("phone", can)
    return Settings(
        of_node, AgentSettings("search"), driver, WebSettings(), FaultSettings(), DeploymentSettings(), settings.origin
    )


def gateway(settings: Settings, node: SwarmNode, seams: Seams, reactor: Any, view: TeamView) -> Gateway:
    """The phones that take part through the web node with these ``seams``, each at a UDP port of its own."""
    from middleware.entangled.network.udp import UdpNetwork

    def of_phone() -> Seams:
        store = MemoryStore(settings.node.store_rows, settings.node.store_bytes, epoch=seams.rng.randbytes(8))
        network = partial(UdpNetwork, reactor, settings.node.host, 0)
        return Seams(reactor, network, store, seams.rng, seams.wall)

    return Gateway(settings, node, of_phone, lambda: view.devices)
