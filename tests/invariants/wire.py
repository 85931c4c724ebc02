"""The workload of the wire: injects datagrams that no correct node sends, and checks invariants R1 to R4.

The injected datagrams are delivered datagrams that are repeated, changed, truncated, or sent to another node or to the
restarted node. The replies to injected datagrams are not delivered, so an injection changes only counters.
"""

from __future__ import annotations

import random
from collections import deque
from typing import Any

from twisted.logger import ILogObserver, LogLevel, globalLogPublisher
from zope.interface import implementer

from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.kademlia.overlay import MAX_FOUND, K
from middleware.entangled.nat.known_peers import MAX_KNOWN
from middleware.entangled.nat.path_tracker import MAX_PORTS
from middleware.entangled.nat.relay import MAX_PAIRS
from middleware.entangled.network.network import Address
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.discovery import TOKEN_BYTES, pack_discovery
from middleware.entangled.wire.dispatcher import MAX_CANCELLED
from middleware.entangled.wire.method import MAX_ENTRIES
from middleware.entangled.wire.peer import MAX_HANDSHAKES, MAX_PEERS, MAX_SESSIONS
from middleware.entangled.wire.session import (
    INIT,
    MAX_RESPONSES,
    MAX_UNCONFIRMED,
    RESPONSES_S,
    Credentials,
    InitiatorHandshake,
    derive_key,
)
from sim.team.clients import record_outcome
from sim.team.event import InvalidDatagram, RequestExecuted, TableSize, UnvalidatedTraffic
from sim.team.schedule import Schedule
from sim.team.simulation import TEAM_KEY
from sim.team.workload import Workload
from tests.fuzz.ground import state_of

KINDS = ("replayed", "replayed", "forged", "forged", "truncated", "misdirected", "malformed", "greeting")
STRANGER = Address("10.66.6.6", 666)
REMEMBERED = 6
"""The number of datagrams stored for each node and type."""
FLOOD = 150
"""The number of simultaneous handshakes of a client with the team's key; it exceeds the limit without a cookie."""


@implementer(ILogObserver)
class Ear:
    """A log observer that records events above the debug level."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def __call__(self, event: Any) -> None:
        """Record an event."""
        if event["log_level"] > LogLevel.debug:
            self.heard.append(str(event.get("log_format")))


class Wire(Workload):
    """Injects datagrams into running nodes, counts the executions of a method, and checks table sizes at the end."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule
        self._board: Any = schedule.team.switchboard
        self._rng = random.Random(f"wire/{schedule.seed}")
        self._history = schedule.history
        self._heard: dict[Address, dict[int, deque[tuple[float, Address, bytes]]]] = {}
        self._answered: list[tuple[Address, bytes]] | None = None
        self._sent_to_stranger = self._got_from_stranger = 0
        self._ear = Ear()
        self._states: dict[str, str] = {}
        self._born_at: dict[Address, float] = {}
        self._number = 0
        carry, deliver = self._board._transmit, self._board._deliver

        def tapped_carry(network: Any, datagram: bytes, to: Address) -> None:
            if self._answered is not None:
                self._answered.append((to, datagram))
                return
            if to == STRANGER:
                self._sent_to_stranger += len(datagram)
            carry(network, datagram, to)

        def tapped_deliver(source: Address, to: Address, datagram: bytes) -> None:
            before = self._board.counters["delivered"]
            deliver(source, to, datagram)
            if self._board.counters["delivered"] > before:
                known = self._heard.setdefault(to, {})
                known.setdefault(datagram[0], deque(maxlen=REMEMBERED)).append(
                    (schedule.team.clock.seconds(), source, datagram)
                )

        vars(self._board).update(_transmit=tapped_carry, _deliver=tapped_deliver)
        # Recorded datagrams are kept after a node has ended, and injected into its next run.
        schedule.team.watch_lives(self._born, lambda place, node: None)

    def step(self) -> None:
        """Inject one or two datagrams, and send a request that must be executed at most once."""
        alive = self._schedule.alive()
        if not alive:
            return
        for _ in range(self._rng.randrange(1, 3)):
            self._shoot(self._rng.choice(alive))
        if len(alive) > 1:
            requester, responder = self._rng.sample(alive, 2)
            self._ask(requester, responder)

    def make_final_requests(self) -> None:
        """Inject a last datagram at each node, and flood one node with handshakes."""
        alive = self._schedule.alive()
        for place in alive:
            self._shoot(place)
        self._flood(self._rng.choice(alive))

    def find_violations(self) -> list[str]:
        """Record the bytes to and from the unknown address, and the sizes of the tables."""
        self._history.record(UnvalidatedTraffic, self._sent_to_stranger, self._got_from_stranger)
        for place in self._schedule.alive():
            for what, size, cap in self._tables(self._schedule.node(place)):
                self._history.record(TableSize, place, what, size, cap)
        return []

    # -- injected datagrams (invariants R1, R3) ---------------------------------------------------------------------

    def _shoot(self, place: int) -> None:
        """Inject a datagram that the node must drop; compare the node's state before and after."""
        own = self._schedule.team.address(place)
        shot = self._made(own)
        if shot is None:
            return
        kind, source, datagram = shot
        node = self._schedule.node(place)
        receiver = node._network.receiver  # type: ignore[attr-defined]
        before, raised = self._state(node), ""
        self._answered = []
        globalLogPublisher.addObserver(self._ear)
        try:
            receiver(datagram, source)
        except Exception as error:  # no exception is permitted
            raised = repr(error)
        finally:
            globalLogPublisher.removeObserver(self._ear)
        answered, self._answered = self._answered, None
        logged = self._ear.heard.pop() if self._ear.heard else ""
        answers = tuple((to == source, len(answer)) for to, answer in answered)
        self._history.record(InvalidDatagram, place, kind, datagram, before, self._state(node), raised, logged, answers)

    def _made(self, own: Address) -> tuple[str, Address, bytes] | None:
        """Return a datagram for the node at ``own``: its kind, source and bytes."""
        rng, now = self._rng, self._schedule.team.clock.seconds()
        kind = rng.choice(KINDS)
        if kind == "greeting":  # the datagram is valid, but its source address is not verified
            return kind, STRANGER, pack_discovery(derive_key(TEAM_KEY, b"greet"), rng.randbytes(TOKEN_BYTES), rng)
        source = rng.choice([STRANGER, None])
        place = own
        if kind == "misdirected":
            others = sorted(address for address in self._heard if address != own)
            if not others:
                return None
            place = rng.choice(others)
        known = self._heard.get(place)
        if not known:
            return None
        recorded = known[rng.choice(sorted(known))]
        _, sender, datagram = rng.choice(recorded)
        at = min(when for when, _, other in recorded if other == datagram)  # the datagram may have been retransmitted
        if kind == "replayed" and datagram[0] == INIT and at < max(now - RESPONSES_S, self._born_at[own]):
            # This opens a session that is useless to an attacker without its keys.
            return None
        if kind == "forged":
            where = rng.randrange(len(datagram))
            datagram = datagram[:where] + bytes([datagram[where] ^ 1 << rng.randrange(8)]) + datagram[where + 1 :]
        elif kind == "truncated":
            datagram = datagram[: rng.randrange(len(datagram))]
        elif kind == "malformed":
            datagram = bytes([rng.choice([0, 0x11, 0x12, 0x13, 0x14, 0x15, 0x16, 0x19, 0x1A, 0xFF])]) + rng.randbytes(
                rng.choice([0, 1, 28, 29, 80, 600, 1300, 3000])
            )
        return kind, source or sender, datagram

    def _state(self, node: EntangledNode) -> str:
        """Return a name for the state of a node. Equal states have equal names in all processes."""
        clock = self._schedule.team.clock
        calls = sorted((time, order) for time, order, call in clock._heap if call.active())
        return self._states.setdefault(state_of([node, node.store, calls]), f"state {len(self._states)}")

    def _flood(self, place: int) -> None:
        """Start more handshakes from unknown members than a node handles simultaneously."""
        node = self._schedule.node(place)
        static = derive_exchange_key(node.identity.public)
        rng = random.Random(f"flood/{self._schedule.seed}")
        own = Credentials.derive(Identity(rng.randbytes(32)), TEAM_KEY)
        for number in range(FLOOD):
            datagram = InitiatorHandshake(own, static, rng.randbytes(32), number, b"").make_init()
            self._got_from_stranger += len(datagram)
            node._network.receiver(datagram, STRANGER)  # type: ignore[attr-defined]
        half_open = len(node.endpoint._half_open._unconfirmed)
        self._history.record(TableSize, place, "handshakes with who showed no cookie", half_open, FLOOD * 4 // 5)

    # -- requests (invariant R2) ------------------------------------------------------------------------------------

    def _born(self, place: int, node: EntangledNode) -> None:
        self._born_at[self._schedule.team.address(place)] = self._schedule.team.clock.seconds()
        life = self._schedule.team.life_numbers[place]

        def run(peer: object, number: int) -> int:
            self._history.record(RequestExecuted, place, life, number)
            return number

        node.endpoint.expose("run", run, changes=True)

    def _ask(self, requester: int, responder: int) -> None:
        self._number += 1
        number, life = self._number, self._schedule.team.life_numbers[responder]
        contact = self._schedule.node(responder).contact
        asked = self._history.record_request(requester, "run", number)

        def shown(answer: object) -> object:
            return answer, responder, life, self._schedule.team.life_numbers[responder]

        asking = self._schedule.node(requester).endpoint.ask(contact, "run", number, changes=True)
        record_outcome(self._history, asked, asking, shown)

    # -- tables (invariant R4) --------------------------------------------------------------------------------------

    def _tables(self, node: EntangledNode) -> list[tuple[str, int, int]]:
        """Return all tables that peers can fill, with their sizes and limits."""
        endpoint: Any = node.endpoint
        peers, responder = endpoint._peers, endpoint._dispatcher
        usage = node.store.usage
        return [
            ("peers", len(peers._peers), MAX_PEERS),
            ("handshakes of its own", len(peers._handshakes), MAX_HANDSHAKES),
            ("sessions", len(peers.sessions), MAX_SESSIONS * len(peers._peers) + MAX_UNCONFIRMED),
            ("sessions that nobody confirmed", len(endpoint._half_open._unconfirmed), MAX_UNCONFIRMED),
            ("answers to handshakes", len(endpoint._half_open._responses), MAX_RESPONSES),
            ("questions", len(responder._history), MAX_ENTRIES),
            ("cancelled questions", len(responder._cancelled), MAX_CANCELLED),
            ("found keys", len(node.overlay._lookup_results), MAX_FOUND),
            *_ways(node),
            ("rows", usage.rows, usage.max_rows),
            ("bytes", usage.bytes, usage.max_bytes),
            *(("contacts in a bucket", len(bucket.entries), K) for bucket in _buckets(node)),
        ]


def _buckets(node: EntangledNode) -> list[Any]:
    table: Any = node.overlay.table
    return list(table._buckets)


def _ways(node: EntangledNode) -> list[tuple[str, int, int]]:
    reach: Any = node.nat
    tables = ("selector", "_relays", "_upgrades", "_limits")
    return [
        ("peers by their ids", len(reach._known), MAX_PEERS),
        ("pairs that are carried for", len(reach.relay), MAX_PAIRS),
        ("fresh ports", len(reach._additional_ports), MAX_PORTS),
        *((f"ways ({name})", len(getattr(reach, name)), MAX_KNOWN) for name in tables),
        ("holes in its router", len(reach.paths._mapped_peers), MAX_KNOWN),
        ("where it is seen", len(reach.external._reports), MAX_KNOWN),
        ("who was told where it is seen", len(reach.external._notified_at), MAX_KNOWN),
    ]
