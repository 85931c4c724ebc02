"""Gateway for phones: the node that serves the page runs a node for each phone.

Each phone has a node with an identity, a port, an agent, and a driver that receives the phone's pictures.  The identity
is derived from a secret of the phone and from the team, so the phone is the same device at every web node.
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

from drivers.phone.driver import TARGET_KEYS, PhoneDriver
from drivers.phone.option import MAX_SIDE_PX, TASK_FPS
from formats.jpeg import read_size
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
from middleware.frontend.team_view import TeamView
from middleware.node import SwarmNode
from swarmnode.assembly import EXPECTED_ERRORS, assemble_node
from swarmnode.dependencies import Dependencies
from webnode.errors import Refusal
from webnode.services import PictureReply

MAX_PHONES = 8
"""Maximum number of phones at one web node; each takes the memory and CPU time of a node."""
PICTURE_TIMEOUT_S = 1.0
"""Seconds of silence after which a phone is considered gone."""
FIRST_PICTURE_TIMEOUT_S = 5.0
"""Seconds to wait for the first picture: the browser may first ask the visitor to allow the camera."""
IDLE_FPS = 5.0
"""Frame rate of a phone without a task: it shows that the phone is present, and saves the phone's battery."""
PICTURE_BURST, PICTURES_PER_S = 20.0, 15.0
"""Rate limit of pictures: burst, and pictures per second."""
JOIN_BURST, JOINS_PER_S = 8.0, 1.0
POSITION_INTERVAL_S = 1.0
"""Minimum seconds between two published positions."""
POSITION_DECIMALS: Mapping[str, int] = {"lat": 5, "lon": 5, "accuracy": 0}
"""Published fields of the position, each with its number of decimals: a precision of about a metre."""
HASH_PERSON = b"phone"


def derive_seed(team: bytes, secret: bytes) -> bytes:
    """Return the seed of a phone's identity in the team ``team``, derived from the phone's ``secret``."""
    return hashlib.blake2s(secret, key=team, person=HASH_PERSON).digest()


def check_picture(jpeg: bytes) -> tuple[int, int]:
    """Return width and height of a picture in pixels; raises ``Refusal`` 400 for an unsupported picture."""
    size = read_size(jpeg)
    if size is None or max(size) > MAX_SIDE_PX:
        problem = "the picture is not a supported JPEG" if jpeg else "the picture is missing or empty"
        raise Refusal("body", problem, f"send a complete JPEG of at most {MAX_SIDE_PX} pixels a side")
    return size


class Gateway:
    """The phones that take part through ``node``.

    ``dependencies`` returns the dependencies of a further node; ``others`` returns the devices that are online.  When a
    phone leaves or stops sending, its node first releases the lease, so another device continues the task immediately.
    """

    _log = Logger()

    def __init__(
        self,
        settings: Settings,
        node: SwarmNode,
        dependencies: Callable[[], Dependencies],
        others: Callable[[], Sequence[Device]],
    ) -> None:
        self._settings = settings
        self._node = node
        self._make_dependencies = dependencies
        self._list_devices = others
        self._phones: dict[str, _Phone] = {}
        self._stopping: dict[str, Deferred[Any]] = {}
        self._removed: dict[str, float] = {}
        self._joins = TokenBucket(JOINS_PER_S, JOIN_BURST)

    def join(self, secret: bytes, name: str, can: Mapping[str, Any]) -> Deferred[str]:
        """Start the node of a phone; fires with its uuid, fails with ``Refusal`` 409, 429 or 503."""
        closed = self._node.team
        seed = derive_seed(
            self._settings.node.team_secret if closed is None else closed.membership_list.operator, secret
        )
        uuid = Identity(seed).node_id.hex()
        if uuid in self._phones:
            self._phones[uuid].restart_timer(FIRST_PICTURE_TIMEOUT_S)
            return succeed(uuid)
        now = self._node.clock.seconds()
        removed_for = self._removed.get(uuid, now) - now
        if removed_for > 0.0:
            return fail(Refusal("phone", "an operator removed this phone", f"wait {removed_for:.0f} s", 409))
        if len(self._phones) >= MAX_PHONES:
            remedy = "wait until a phone leaves, or join at another web node"
            return fail(Refusal("phone", f"this node already has {MAX_PHONES} phones", remedy, 409))
        team = self._node.team
        if team is not None and GATEWAY not in team.admission.me.roles:
            remedy = f"ask the operator to run: swarm promote {team.admission.me.name} --role {GATEWAY}"
            return fail(Refusal("phone", "this node may not admit guests to its team", remedy, 409))
        if not self._joins.take(now):
            return fail(Refusal("phone", "too many phones join at once", "try again in a few seconds", 429))
        joined: Deferred[str] = Deferred()

        def enter(left: Any) -> Any:
            try:
                if uuid not in self._phones:
                    self._phones[uuid] = self._start_phone(uuid, seed, self._unique_name(name, uuid), can)
                joined.callback(uuid)
            except EXPECTED_ERRORS as error:
                joined.errback(
                    Refusal("phone", f"the node of this phone cannot start: {error}", "try again in a moment", 503)
                )
            return left

        # Wait until the previous node of the same phone has stopped.
        self._stopping.get(uuid, succeed(None)).addCallback(enter)
        return joined

    def receive_picture(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> PictureReply:
        """Process a picture and readings of a phone; raises ``Refusal`` 400, 404 or 429."""
        size = check_picture(jpeg)
        phone = self._phones.get(uuid)
        if phone is None:
            raise Refusal("uuid", "this phone has not joined at this node", "join with POST /api/v1/phones", 404)
        phone.restart_timer(PICTURE_TIMEOUT_S)
        if not phone.bucket.take(self._node.clock.seconds()):
            raise Refusal("phone", "the phone sends too many pictures", f"send at most {TASK_FPS:g} a second", 429)
        return phone.process_picture(jpeg, size, values)

    def leave(self, uuid: str) -> None:
        """Stop the node of the phone ``uuid``; do nothing if the phone has no node here."""
        phone = self._phones.pop(uuid, None)
        if phone is None:
            return

        def gone(_: object) -> None:
            self._stopping.pop(uuid, None)

        ending = self._stopping[uuid] = phone.stop()
        ending.addBoth(gone)

    def close(self) -> Deferred[Any]:
        """Stop the nodes of all phones; fires when they have stopped."""
        for uuid in list(self._phones):
            self.leave(uuid)
        waiting = [ending.addCallback(lambda _: None) for ending in self._stopping.values()]
        return DeferredList(waiting, consumeErrors=True)

    def _start_phone(self, uuid: str, seed: bytes, name: str, can: Mapping[str, Any]) -> _Phone:
        dependencies = self._make_dependencies()
        dependencies.store.set_note("identity", seed)
        if self._node.team is not None:
            from middleware.admission.membership_file import MemoryMembership

            dependencies = replace(dependencies, membership=MemoryMembership(self._node.team.create_guest(seed, name)))
        settings = _make_settings(self._settings, self._node, name, can)
        assembly = assemble_node(settings, dependencies)
        assert isinstance(assembly.driver, PhoneDriver) and assembly.agent is not None
        phone = _Phone(assembly.node, assembly.agent, assembly.driver, partial(self._on_silence, uuid))
        assembly.node.on_disconnect(partial(self._on_removed, uuid))
        phone.start()
        return phone

    def _unique_name(self, name: str, uuid: str) -> str:
        """Return ``name``, or a unique variant of it if another device has it."""
        taken = {device.name for device in self._list_devices() if device.uuid != uuid}
        taken |= {phone.name for other, phone in self._phones.items() if other != uuid}
        return name if name not in taken else f"{name[:35]}-{uuid[:4]}"

    def _on_silence(self, uuid: str) -> None:
        self._log.info("the phone {name} has stopped sending pictures", name=self._phones[uuid].name)
        self.leave(uuid)

    def _on_removed(self, uuid: str, seconds: float) -> None:
        now = self._node.clock.seconds()
        self._removed = {other: until for other, until in self._removed.items() if until > now}
        self._removed[uuid] = now + seconds
        self.leave(uuid)


class _Phone:
    """The node, agent and driver of one phone; ``silent`` is called when the phone stops sending."""

    def __init__(self, node: SwarmNode, agent: Service, driver: PhoneDriver, silent: Callable[[], None]) -> None:
        self.name = node.presence.device.name
        self.bucket = TokenBucket(PICTURES_PER_S, PICTURE_BURST)
        self._node = node
        self._agent = agent
        self._driver = driver
        self._on_silence = silent
        self._timer: IDelayedCall | None = None
        self._position_sent_at = 0.0

    def start(self) -> None:
        """Open the port and join; raises one of ``EXPECTED_ERRORS`` if that fails."""
        self._node.startService()
        self._agent.startService()
        self.restart_timer(FIRST_PICTURE_TIMEOUT_S)

    def stop(self) -> Deferred[Any]:
        """Release the lease, then leave the network."""
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        return maybeDeferred(self._agent.stopService).addBoth(lambda _: self._node.stopService())

    def restart_timer(self, seconds: float) -> None:
        """Restart the timer for the next picture."""
        if self._timer is not None and self._timer.active():
            self._timer.reset(seconds)
        else:
            self._timer = self._node.clock.callLater(seconds, self._on_silence)

    def process_picture(self, jpeg: bytes, size: tuple[int, int], values: Mapping[str, float]) -> PictureReply:
        """Pass a picture to the driver; return the requested frame rate and the instruction for the visitor."""
        self._driver.process_picture(jpeg, *size, values)
        now = self._node.clock.seconds()
        place = {
            key: round(values[f"position.{key}"], n)
            for key, n in POSITION_DECIMALS.items()
            if f"position.{key}" in values
        }
        if place and now - self._position_sent_at >= POSITION_INTERVAL_S:
            self._position_sent_at = now
            self._node.presence.change(position=place)
        device = self._node.presence.device
        return PictureReply(
            TASK_FPS if device.task else IDLE_FPS, self._make_instruction(device, TARGET_KEYS[0] in values)
        )

    def _make_instruction(self, device: Device, is_seen: bool) -> str:
        """Return the instruction for the visitor."""
        if self._node.stop_state.is_stopped:
            return "The team is stopped. Wait."
        if device.status == EXECUTING:
            return (
                "You have the task: keep the target in view."
                if is_seen
                else "You have the task, but the target is out of sight: turn until you see it."
            )
        if device.status == DONE:
            return "Done. Thank you."
        if device.status == IDLE or not device.task:
            return "Nothing to do at the moment."
        return (
            "You see it. Keep it in view, ready to take over." if is_seen else "Look for the red target: turn slowly."
        )


def _make_settings(settings: Settings, node: SwarmNode, name: str, can: Mapping[str, Any]) -> Settings:
    """Return the settings of a phone's node, which joins through ``node`` and allows neither faults nor deployment."""
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


def make_gateway(
    settings: Settings, node: SwarmNode, dependencies: Dependencies, reactor: Any, view: TeamView
) -> Gateway:
    """Return the gateway of the web node with these ``dependencies``; each phone has a separate UDP port."""
    from middleware.entangled.network.udp import UdpNetwork

    def of_phone() -> Dependencies:
        store = MemoryStore(settings.node.store_rows, settings.node.store_bytes, epoch=dependencies.rng.randbytes(8))
        network = partial(UdpNetwork, reactor, settings.node.host, 0)
        return Dependencies(reactor, network, store, dependencies.rng, dependencies.wall)

    return Gateway(settings, node, of_phone, lambda: view.devices)
