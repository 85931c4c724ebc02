"""SwarmNode: one Twisted service that wires the rooms of the middleware; it decides nothing itself.

What a device can do with its team goes through here: be present, see the devices and tasks, submit and follow a task, ask
the council for a lease, send a camera's frames, and call a peer by name.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.consensus.lease import Acceptor, Lessee
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.network.network import Address, Network
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.store import Store
from middleware.entangled.watch import Changed, Watch
from middleware.presence import DEVICES, Device, Presence, devices_of
from middleware.streams import Streams
from middleware.tasks import MEMBER, RESULT, TASKS, Member, Result, Task, group_key

COUNCIL = 3
CAMERA = "camera"


class SwarmNode(Service):
    """One node of a team.

    ``device`` is what the node says of itself; ``wall`` gives seconds of the wall clock, for people only.
    """

    _log = Logger()

    def __init__(
        self,
        device: Device,
        identity: Identity,
        team_key: bytes,
        known_nodes: Sequence[Address],
        network: Network,
        store: Store,
        clock: IReactorTime,
        rng: random.Random,
        wall: Callable[[], float],
        lease: float = 1.0,
    ) -> None:
        self.clock = clock
        self.rng = rng
        self.wall = wall
        self.store = store
        self.entangled = EntangledNode(identity, team_key, network, store, clock, rng, lease)
        self.uuid = identity.node_id.hex()
        self.presence = Presence(device, self._announce, self._later)
        self.streams = Streams(self.entangled.endpoint, clock)
        self.joined: Deferred[None] = Deferred()
        self._known = list(known_nodes)
        self._network = network
        self._acceptor = Acceptor()
        self._on_message: Callable[[str], None] = lambda text: None
        self._on_disconnect: Callable[[float], None] = lambda seconds: None
        expose = self.entangled.endpoint.expose
        expose("lease.claim", self._answer_claim, changes=True)
        expose("lease.release", self._answer_release, changes=True)
        expose("device.message", self._answer_message, changes=True)
        expose("device.disconnect", self._answer_disconnect, changes=True)

    # -- life -------------------------------------------------------------------------------------------------------

    def startService(self) -> None:
        """Open the port, join the network through the known nodes, and appear among the devices."""
        super().startService()
        self.entangled.start()
        joining = Deferred.fromCoroutine(self._join())
        joining.addErrback(self._not_joined)

    def stopService(self) -> None:
        """Say goodbye and close everything but the store, which belongs to whoever opened it."""
        self.streams.stop()
        self.entangled.stop()
        super().stopService()  # type: ignore[no-untyped-call]

    def vanish(self) -> None:
        """Leave without a word, as when the power fails."""
        self.streams.stop()
        self.entangled.vanish()
        super().stopService()  # type: ignore[no-untyped-call]

    async def _join(self) -> None:
        await self.entangled.join(self._known)
        there = devices_of(await self.entangled.get(DEVICES))
        own = [d.joined for d, _ in there if d.uuid == self.uuid]
        joined = own[0] if own else max((d.joined for d, _ in there), default=0) + 1
        self.presence.device = self._addressed(self.presence.device)
        self.presence.appear(joined)
        self._log.info("{name} joined as number {joined}", name=self.presence.device.name, joined=joined)
        self.joined.callback(None)

    def _addressed(self, device: Device) -> Device:
        return replace(device, uuid=self.uuid, address=str(self._network.address), since=self.wall())

    def _not_joined(self, failure: Any) -> None:
        if failure.check(EntangledError) is None:
            self._log.failure("while joining", failure)

    # -- devices ----------------------------------------------------------------------------------------------------

    def watch_devices(self, changed: Changed) -> Watch:
        """Follow who is here; ``devices_of`` reads the records."""
        return self.entangled.watch(DEVICES, changed)

    def contact_of(self, record: Record) -> Contact | None:
        """How to reach the device that wrote ``record``."""
        pair = next(iter(devices_of([record])), None)
        if pair is None:
            return None
        host, _, port = pair[0].address.rpartition(":")
        return Contact(record.owner, Address(host, int(port))) if host and port.isdigit() else None

    def on_message(self, receive: Callable[[str], None]) -> None:
        """Call ``receive`` with each text that an operator sends to this device."""
        self._on_message = receive

    def on_disconnect(self, leave: Callable[[float], None]) -> None:
        """Call ``leave`` with seconds when an operator takes this device off the network for that long."""
        self._on_disconnect = leave

    # -- tasks ------------------------------------------------------------------------------------------------------

    async def submit(self, task: Task) -> Task:
        """Publish ``task`` with the council pinned: the nodes closest to its key now (consensus rule 1)."""
        key = group_key(task.task_id)
        nearest = await self.entangled.find_node(key)
        council = closest([*nearest, self.entangled.contact], key, COUNCIL)
        task = replace(task, council=tuple(council))
        await self.entangled.put(TASKS, task.task_id, task.packed(), "team")
        return task

    def watch_tasks(self, changed: Changed) -> Watch:
        """Follow the tasks of the team."""
        return self.entangled.watch(TASKS, changed)

    def watch_group(self, task_id: str, changed: Changed) -> Watch:
        """Follow the reports and the outcome of one task."""
        return self.entangled.watch(group_key(task_id), changed)

    def report(self, task_id: str, member: Member) -> None:
        """Tell the other participants of a task; gone with this node, should it go."""
        self._quietly(self.entangled.put(group_key(task_id), MEMBER, member.packed(), "leased"))

    def withdraw(self, task_id: str) -> None:
        """Take this node's report back."""
        self._quietly(self.entangled.remove(group_key(task_id), MEMBER))

    def conclude(self, task_id: str, result: Result) -> Deferred[int]:
        """Record how a task ended; stays when this node goes."""
        return self.entangled.put(group_key(task_id), RESULT, result.packed(), "team")

    def lessee(self, task: Task, changed: Callable[[], None], floor: int) -> Lessee:
        """The claimant of the right to act on ``task``, in this node's name."""

        def ask(member: int, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
            contact = task.council[member]
            if contact.node_id == self.entangled.identity.node_id:
                answer = self._answer_claim if method == "lease.claim" else self._answer_release
                return succeed(answer(contact, *arguments))
            return self.entangled.endpoint.ask(contact, method, *arguments, changes=True, timeout=task.lease_ttl / 3)

        return Lessee(
            task.task_id, self.uuid, task.lease_ttl, len(task.council), ask, self.clock, self.rng, changed, floor
        )

    # -- what peers ask ---------------------------------------------------------------------------------------------

    def _answer_claim(self, peer: Contact, task_id: str, token: int, ttl: float) -> list[object]:
        if not isinstance(task_id, str) or type(token) is not int or not 0 < token < 2**62:
            raise Refused("lease.claim takes a task id, a positive token and a duration")
        if not isinstance(ttl, float) or not 0.0 < ttl <= 60.0:
            raise Refused("a lease lasts more than 0 and at most 60 seconds")
        grant = self._acceptor.claim(task_id, peer.node_id.hex(), token, ttl, self.clock.seconds())
        return [grant.granted, grant.token, grant.remaining]

    def _answer_release(self, peer: Contact, task_id: str, token: int) -> None:
        self._acceptor.release(task_id, peer.node_id.hex(), token, self.clock.seconds())

    def _answer_message(self, peer: Contact, text: str) -> str:
        if not isinstance(text, str) or not 0 < len(text) <= 200:
            raise Refused("a message is a text of 1 to 200 characters")
        self._on_message(text)
        self.presence.say(self.wall(), f"operator: {text}")
        return "delivered"

    def _answer_disconnect(self, peer: Contact, seconds: float) -> str:
        if not isinstance(seconds, float | int) or not 0 < seconds <= 3600:
            raise Refused("a device leaves for more than 0 and at most 3600 seconds")
        # After the answer is out.
        self.clock.callLater(0.05, self._on_disconnect, float(seconds))
        return "leaving"

    # -- inside -----------------------------------------------------------------------------------------------------

    def _announce(self, value: bytes) -> None:
        self._quietly(self.entangled.put(DEVICES, self.presence.device.name, value, "leased"))

    def _later(self, delay: float, work: Callable[[], None]) -> object:
        return self.clock.callLater(delay, lambda: work() if self.running else None)

    def _quietly(self, work: Deferred[Any]) -> None:
        def ended(failure: Any) -> None:
            if failure.check(EntangledError) is None:
                self._log.failure("while telling the team", failure)

        work.addErrback(ended)

