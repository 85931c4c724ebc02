"""Try every method and every record namespace of a running team as each kind of insider.

``python -m tests.attacks.role_matrix`` prints the counts. The insiders are a viewer, a device, a gateway, and an
operator with a revoked certificate. Each insider has a real key and a real certificate, and uses the real protocol. The
role table (``middleware.admission.roles``) determines which attempts are forbidden: every node has to reject each of
them, and the state of the team must not change.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import maybeDeferred

from middleware.admission.roles import (
    DEVICE,
    GATEWAY,
    KINDS,
    METHODS,
    NAMESPACES,
    OPERATOR,
    PRESENCE,
    VIEWER,
    classify_slot,
    may_call,
    may_store,
)
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NotAdmitted, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, Slot
from middleware.entangled.wire.admission_check import ROLE
from middleware.entangled.wire.endpoint import Endpoint
from swarmnode.simulated_team import SimulatedTeam
from tests.attacks.siege import AnyAdmission

REVOKED_OPERATOR = "revoked operator"
SUBJECTS = (VIEWER, DEVICE, GATEWAY, REVOKED_OPERATOR)
UNLISTED_METHOD = "made.up"
"""A method that a program exposes but that the role table does not contain."""
REVOCATION_S = 12.0
"""Seconds within which every connected node learns of a revocation."""
ARGUMENTS: dict[str, Sequence[object]] = {
    "device.message": ["hello"],
    "device.disconnect": [30.0],
    "device.tune": ["camera_fps", 1.0],
    "device.fault": ["kill", 30.0, 1.0],
    "device.assign": ["search"],
    "stream.part": [1, b"x"],
}
"""Arguments with which a method would have an effect; methods that are missing here are called without arguments."""


@dataclass
class Counts:
    """The outcome of the attempts of one insider.

    ``wrong`` lists the attempts with an outcome that contradicts the role table.
    """

    subject: str
    methods: int = 0
    methods_refused: int = 0
    records: int = 0
    records_refused: int = 0
    allowed: int = 0
    changes: int = 0
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return (
            f"{self.subject:<18} {self.methods:>5} calls, {self.methods_refused:>5} refused"
            f"   {self.records:>5} records, {self.records_refused:>5} refused"
            f"   {self.allowed:>5} allowed   {self.changes} changes   {len(self.wrong)} wrong"
        )


def list_slots(owner: bytes) -> list[Slot]:
    """Return all combinations of a key and a slot name of the role table's namespaces, for ``owner``."""
    examples = [namespace.slot(owner) for namespace in NAMESPACES.values()]
    keys = dict.fromkeys(slot.key for slot in examples)
    names = dict.fromkeys([*(slot.name for slot in examples), "x"])
    return [Slot(key, owner, name) for key in keys for name in names]


class Insider:
    """A member that makes the attempts: its key, its current roles, and its endpoint."""

    def __init__(self, team: SimulatedTeam, name: str, roles: Sequence[str], port: int) -> None:
        rng = random.Random(f"insider {name}")
        secret = team._memberships[team.BOOTSTRAP].membership.secrets[0][1]
        paper = team.operator.create_membership(name, roles, team.clock.seconds(), rng, secret)
        self.identity: Identity = paper.identity
        self.roles = tuple(roles)
        self.name = name
        network = team.switchboard.make_network("127.0.0.1", port)
        self.endpoint = Endpoint(self.identity, secret, network, team.clock, rng, AnyAdmission(paper.certificate))
        self.endpoint.start()


class Trial:
    """One team, and one insider that makes every attempt at each node of the team."""

    def __init__(self, subject: str, seed: int = 1) -> None:
        self.counts = Counts(subject)
        self.team = SimulatedTeam(seed, camera_fps=0.5, dogs=("dog1", "dog2"), faults=True)
        self.nodes = {name: service.assembly.node for name, service in self.team.services.items()}
        for node in self.nodes.values():
            _ = (
                node.entangled.take_acceptor,
                node.council_manager,
                node.auction_service,
            )  # a node exposes the methods of these objects when it first uses them
            node.entangled.endpoint.expose(UNLISTED_METHOD, lambda peer: None, changes=True)
        is_revoked = subject == REVOKED_OPERATOR
        self.insider = Insider(self.team, "mallory", [OPERATOR] if is_revoked else [subject], 7601)
        self.accomplice = Insider(self.team, "accomplice", [DEVICE], 7602)
        for each in (self.insider, self.accomplice):
            for contact in self._contacts():
                each.endpoint.ask(contact, "ping", bytes(8), changes=True).addErrback(lambda failure: None)
        self.team.clock.advance(6.0)
        if is_revoked:
            team = self.nodes[self.team.BOOTSTRAP].team
            assert team is not None
            statement = self.team.operator.revoke(self.insider.identity.public, "mallory", self.team.clock.seconds())
            self._wait(lambda: team.publish(statement))
            self.team.clock.advance(REVOCATION_S)
            self.insider.roles = ()

    def run(self) -> Counts:
        """Try the forbidden attempts, compare the state of the team, try the allowed attempts, and return the counts.

        Records are sent directly, and through an accomplice with the role device.
        """
        before = self._state()
        for name, node in self.nodes.items():
            self._try_methods(name, node.entangled.contact)
            self._try_records(name, node.entangled.contact)
        self.team.clock.advance(5.0)
        after = self._state()
        changed = sorted(_describe(key) for key in {*before, *after} if before.get(key) != after.get(key))
        self.counts.changes = len(changed)
        self.counts.wrong += [f"changed: {key}" for key in changed]
        for name, node in self.nodes.items():
            self._try_allowed(name, node.entangled.contact)
        return self.counts

    def stop(self) -> None:
        self.insider.endpoint.stop()
        self.accomplice.endpoint.stop()
        self.team.stop()
        self.team.clock.advance(60.0)

    def _try_methods(self, name: str, contact: Contact) -> None:
        for method in (*METHODS, UNLISTED_METHOD):
            if may_call(self.insider.roles, method):
                continue
            self.counts.methods += 1
            outcome = self._outcome(self.insider, contact, method, *ARGUMENTS.get(method, ()))
            self.insider.endpoint.notify(contact, method, *ARGUMENTS.get(method, ()))
            if _is_refusal(outcome):
                self.counts.methods_refused += 1
            else:
                self.counts.wrong.append(f"{name} {method}: {outcome!r}")

    def _try_allowed(self, name: str, contact: Contact) -> None:
        """Call the allowed methods without arguments; ``goodbye`` is last, because after it a node drops the peer."""
        allowed = [method for method in METHODS if may_call(self.insider.roles, method) and method != "goodbye"]
        for method in (*allowed, *(["goodbye"] if may_call(self.insider.roles, "goodbye") else [])):
            self.counts.allowed += 1
            outcome = self._outcome(self.insider, contact, method)
            if _is_refusal(outcome):
                self.counts.wrong.append(f"{name} {method} is refused: {outcome!r}")

    def _try_records(self, name: str, contact: Contact) -> None:
        own = self.insider.identity
        for slot in list_slots(own.public):
            if may_store(self.insider.roles, slot):
                continue
            record = Record(slot.key, slot.name, slot.owner, 1, "team", 600.0, b"\xc3").sign(own)
            packed = [record.pack()]
            for carrier, arguments in (
                (self.insider, (packed,)),
                (self.accomplice, (packed, [600.0])),
            ):
                self.counts.records += 1
                outcome = self._outcome(carrier, contact, "store", *arguments)
                is_held = self.nodes[name].entangled.replica.holds(record)
                is_refused = _is_refusal(outcome) or (isinstance(outcome, list) and outcome[0] < 0)
                if is_refused and not is_held:
                    self.counts.records_refused += 1
                else:
                    self.counts.wrong.append(f"{name} {carrier.name} {classify_slot(slot)} {slot.name}: {outcome!r}")

    def _outcome(self, insider: Insider, contact: Contact, method: str, *arguments: object) -> Any:
        return self._wait(lambda: insider.endpoint.ask(contact, method, *arguments, changes=True, timeout=2.0))

    def _wait(self, work: Callable[[], Any]) -> Any:
        found: list[Any] = []
        maybeDeferred(work).addCallbacks(found.append, lambda failure: found.append(failure.value))
        for _ in range(60):
            if found:
                return found[0]
            self.team.clock.advance(0.05)
        return None

    def _contacts(self) -> list[Contact]:
        return [node.entangled.contact for node in self.nodes.values()]

    def _state(self) -> dict[tuple[str, Any], object]:
        """Return the part of the team's state that an insider may change only if its roles permit the change."""
        found: dict[tuple[str, Any], object] = {}
        for name, node in self.nodes.items():
            for record in node.store.records():
                if classify_slot(record.slot) != PRESENCE:
                    found[name, record.slot] = record.digest()
            found[name, "stopped"] = node.stop_state.is_motion_forbidden
            found[name, "tuning"] = node.store.get_note("tuning")
            found[name, "running"] = node.running
            assert node.team is not None
            found[name, "roll"] = node.team.membership_list.digest
        for robot in self.team.get_true_state()["dogs"]:
            found[robot["name"], "position"] = (round(robot["x"], 3), round(robot["y"], 3))
        return found


def _describe(key: tuple[str, Any]) -> str:
    node, item = key
    return f"{node} {classify_slot(item)} {item.name}" if isinstance(item, Slot) else f"{node} {item}"


def _is_refusal(outcome: object) -> bool:
    return isinstance(outcome, NotAdmitted) or (isinstance(outcome, Refused) and outcome.code == ROLE)


def try_everything(subject: str) -> Counts:
    """Let an insider of this kind make every attempt at a new team."""
    trial = Trial(subject)
    try:
        return trial.run()
    finally:
        trial.stop()


def main() -> int:
    """Print one line for each kind of insider; the exit code is 1 if an outcome contradicts the role table."""
    found = [try_everything(subject) for subject in SUBJECTS]
    lines = [line for counts in found for line in (str(counts), *(f"    {wrong}" for wrong in counts.wrong))]
    sys.stdout.write("\n".join([*lines, f"{len(METHODS)} methods, {len(KINDS)} namespaces", ""]))
    return int(any(counts.wrong for counts in found))


if __name__ == "__main__":
    sys.exit(main())
