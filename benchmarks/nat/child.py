"""Run real nodes on one host of the test network (``sim.namespaces``), controlled by JSON lines.

Started as ``python -m benchmarks.nat.child``. A trial is a separate team, so many trials can run in one process. The
measurements are taken at the node: the time of its first request to a peer, and of the first answer.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Callable
from typing import Any

from twisted.internet import reactor as _reactor
from twisted.internet.defer import Deferred

from middleware.config.settings import Settings
from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.node import EntangledNode
from swarmnode.environment import make_dependencies

Order = dict[str, Any]
reactor: Any = _reactor
CALL_METHOD = "matrix.hello"
RETRY_S = 0.25
"""Seconds between two calls to a peer that has not answered yet."""
IN_FLIGHT = 8


class PeerObservation:
    """The observations of one node about one peer."""

    def __init__(self) -> None:
        self.contact: Contact | None = None
        """The contact that the node calls."""
        self.confirmed: Contact | None = None
        """The contact that answered, or connected."""
        self.known_at = self.answered_at = -1.0
        self.path = ""
        self.waiting: list[Callable[[], None]] = []


class Member:
    """A node of a trial, with hooks that record its requests."""

    def __init__(self, settings: Settings, seed: bytes) -> None:
        dependencies = make_dependencies(settings, reactor)
        identity, network = Identity(seed), dependencies.network()
        self.node = EntangledNode(
            identity, settings.node.team_secret, network, dependencies.store, reactor, dependencies.rng
        )
        self.observations: dict[bytes, PeerObservation] = {}
        self.wanted_peers: dict[bytes, float] = {}
        """Peers that are called as soon as they are known, with the maximum duration in seconds."""
        self._network = network
        endpoint = self.node.endpoint
        self._ask = endpoint.ask
        # The time at which a node learns of a peer shows only in the node's own requests, so these are intercepted.
        endpoint.ask = self._ask_and_record  # type: ignore[method-assign]
        endpoint.on_contact.add(self._on_contact)
        self.node.rpc(CALL_METHOD)(lambda peer: True)

    def get_observation(self, public: bytes) -> PeerObservation:
        """Return the observations about the peer with that key."""
        return self.observations.setdefault(public, PeerObservation())

    def start(self) -> int:
        """Open the port and return it."""
        self.node.start()
        return self._network.address.port

    def call(self, public: bytes, done: Callable[[float], None], limit_s: float) -> None:
        """Call a peer until it answers; call ``done`` with the duration in seconds, or -1 after ``limit_s``."""
        started_at = reactor.seconds()
        state = {"open": True, "in flight": 0}

        def over(seconds: float) -> None:
            if state["open"]:
                state["open"] = False
                done(seconds)

        def answered(_: object) -> None:
            state["in flight"] -= 1
            over(reactor.seconds() - started_at)

        def failed(failure: Any) -> None:
            state["in flight"] -= 1
            failure.trap(EntangledError)

        def again() -> None:
            if not state["open"]:
                return
            if reactor.seconds() - started_at > limit_s:
                over(-1.0)
                return
            observation = self.get_observation(public)
            contact = observation.confirmed or observation.contact
            if contact is not None and state["in flight"] < IN_FLIGHT:
                state["in flight"] += 1
                asked: Deferred[Any] = self.node.call(contact, CALL_METHOD)
                asked.addCallbacks(answered, failed)
            reactor.callLater(RETRY_S, again)

        again()

    def get_path(self, public: bytes) -> str:
        """Return the present path to a peer."""
        proved = self.get_observation(public).confirmed
        return "" if proved is None else find_path_kind(proved)

    def _ask_and_record(self, contact: Contact, method: str, *arguments: object, **options: Any) -> Deferred[Any]:
        observation = self.get_observation(contact.public)
        self._record_contact(contact, observation)
        asked = self._ask(contact, method, *arguments, **options)

        def answered(answer: object) -> object:
            if observation.answered_at < 0:
                observation.answered_at = reactor.seconds()
                observation.path = self.get_path(contact.public)
                for waiting in observation.waiting:
                    waiting()
            return answer

        return asked.addCallback(answered)

    def _on_contact(self, contact: Contact) -> None:
        observation = self.get_observation(contact.public)
        observation.confirmed = contact
        self._record_contact(contact, observation)

    def _record_contact(self, contact: Contact, observation: PeerObservation) -> None:
        observation.contact = contact
        if observation.known_at < 0:
            observation.known_at = reactor.seconds()
            if contact.public in self.wanted_peers:
                # Simulate an application that calls each discovered peer; its call follows the node's own request.
                reactor.callLater(0.0, self.call, contact.public, lambda _: None, self.wanted_peers[contact.public])


def find_path_kind(contact: Contact) -> str:
    """Return the kind of path from the address of a contact."""
    host = contact.address.host
    if host.startswith("~wss"):
        return "tunnel"
    return "relayed" if host.startswith("~") else "direct"


class OrderExecutor:
    """Execute orders and answer each by its id."""

    def __init__(self) -> None:
        self._members: dict[str, Member] = {}
        self._lock = threading.Lock()
        self._out = os.fdopen(os.dup(1), "w")
        # Only orders use the real standard output; output of libraries goes to standard error.
        os.dup2(2, 1)

    def begin(self) -> None:
        """Start to read orders."""
        threading.Thread(target=self._read, daemon=True).start()
        self._answer({"id": 0})

    def _read(self) -> None:
        for line in sys.stdin:
            reactor.callFromThread(self._execute, json.loads(line))
        os._exit(0)

    def _execute(self, order: Order) -> None:
        try:
            getattr(self, "_do_" + order["do"])(order)
        except Exception as error:
            self._answer(order, cannot=f"{type(error).__name__}: {error}")

    def _answer(self, order: Order, **fields: object) -> None:
        with self._lock:
            self._out.write(json.dumps({"id": order["id"], **fields}) + "\n")
            self._out.flush()

    # -- orders -----------------------------------------------------------------------------------------------------

    def _do_start(self, order: Order) -> None:
        """Start a node; answer when it has joined (immediately for the first node of a team), or at the time limit."""
        settings = Settings.from_mapping({"node": order["node"]}, "trial")
        member = self._members[order["trial"]] = Member(settings, bytes.fromhex(order["seed"]))
        member.wanted_peers = {bytes.fromhex(public): order["limit_s"] for public in order["sought"]}
        port, started_at = member.start(), reactor.seconds()
        late = reactor.callLater(order["limit_s"], self._answer, order, port=port, joined_s=None)

        def joined(_: object) -> None:
            if late.active():
                late.cancel()
                self._answer(order, port=port, joined_s=reactor.seconds() - started_at)

        member.node.join(settings.node.known_nodes).addCallbacks(joined, lambda _: None)

    def _do_meet(self, order: Order) -> None:
        """Wait until a peer has answered; return the seconds since the node learnt of the peer."""
        member = self._members[order["trial"]]
        public = bytes.fromhex(order["peer"])
        observation = member.get_observation(public)

        def tell() -> None:
            if not timer.active():
                return
            timer.cancel()
            self._answer(order, took_s=observation.answered_at - observation.known_at, path=observation.path)

        def late() -> None:
            self._answer(order, took_s=None, path="", known=observation.known_at >= 0)

        timer = reactor.callLater(order["limit_s"], late)
        if observation.answered_at >= 0:
            tell()
        else:
            observation.waiting.append(tell)

    def _do_call(self, order: Order) -> None:
        """Call a peer until it answers."""
        member, public = self._members[order["trial"]], bytes.fromhex(order["peer"])

        def done(seconds: float) -> None:
            self._answer(order, took_s=None if seconds < 0 else seconds, path=member.get_path(public))

        member.call(public, done, order["limit_s"])

    def _do_path(self, order: Order) -> None:
        """Return the present path to a peer."""
        self._answer(order, path=self._members[order["trial"]].get_path(bytes.fromhex(order["peer"])))

    def _do_stop(self, order: Order) -> None:
        """Stop nodes without notifying their peers."""
        for trial in order["trials"]:
            member = self._members.pop(trial, None)
            if member is not None:
                member.node.stop_silently()
        self._answer(order)


def main() -> None:
    """Execute orders until the input ends."""
    logging.disable(logging.CRITICAL)
    use_monotonic_time()
    reactor.callWhenRunning(OrderExecutor().begin)
    reactor.run(installSignalHandlers=False)


if __name__ == "__main__":
    main()
