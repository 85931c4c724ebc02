"""Tests of ``admission.roles``: the table covers all methods and slots of a node, and a team works with it."""

from __future__ import annotations

from functools import partial
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import roles
from middleware.admission.roles import (
    BOOTSTRAP,
    DEVICE,
    GATEWAY,
    KINDS,
    METHODS,
    OPERATOR,
    OTHER,
    ROLES,
    VIEWER,
    classify_slot,
    may_call,
    may_store,
)
from middleware.config.settings import Settings
from middleware.consensus import decision_record
from middleware.deployment.manifest import manifests_key
from middleware.directory import presence
from middleware.directory.prefix import compute_places
from middleware.entangled.identity import Identity
from middleware.entangled.record import Slot, hash_key
from middleware.entangled.wire.admission_check import Authority, OpenAdmission
from middleware.node import SwarmNode
from middleware.stop import stop_state
from middleware.tasks import task as tasks
from sim.demo.trials import run_trial
from swarmnode import assembly, deploy
from swarmnode.simulated_team import SimulatedTeam
from tests.swarmnode.team import KEY, MemoryTeam
from webnode import revocation

ABSENT = ("roll.", "reach.")
"""Prefixes of methods that only some nodes expose."""


class RoleAdmission(OpenAdmission):
    """Admits every node, and looks up the roles in ``roles`` by public key.

    ``refusals`` collects denied calls and writes.
    """

    def __init__(self, known: dict[bytes, tuple[str, ...]], refusals: list[tuple[tuple[str, ...], str]]) -> None:
        self._known = known
        self._refusals = refusals

    def may_call(self, public: bytes, method: str) -> bool:
        return self._noted(may_call(self._known[public], method), public, method)

    def may_store(self, slot: Slot) -> bool:
        return self._noted(may_store(self._known[slot.owner], slot), slot.owner, classify_slot(slot))

    def may_keep(self, slot: Slot) -> bool:
        return may_store(self._known[slot.owner], slot)

    def find_authority(self, owner: bytes) -> Authority:
        return Authority("", self._known[owner])

    def _noted(self, is_allowed: bool, public: bytes, what: str) -> bool:
        if not is_allowed:
            self._refusals.append((self._known[public], what))
        return is_allowed


def slot(key: bytes, name: str = "x") -> Slot:
    return Slot(key, Identity(bytes(32)).public, name)


class TableTests(SynchronousTestCase):
    def exposed(self) -> set[str]:
        """Return the methods of a real node with a robot, an agent and all options enabled."""
        tables: dict[str, Any] = {
            "node": {"name": "a", "team_key": KEY},
            "driver": {"kind": "sim"},
            "agent": {"module": "search"},
            "faults": {"allow": True},
            "deployment": {"allow": True},
        }
        made = assembly.assemble_node(Settings.from_mapping(tables, "test"), MemoryTeam().make_dependencies("a", 7000))
        node = made.node
        _ = node.entangled.take_acceptor, node.council_manager, node.auction_service
        return set(node.entangled.endpoint._dispatcher.methods)

    def test_every_method_has_an_entry(self) -> None:
        """Each exposed method has an entry in the table, and each entry has an exposed method."""
        exposed = self.exposed()
        self.assertGreater(len(exposed), 40)
        self.assertEqual(sorted(exposed - set(METHODS)), [])
        self.assertEqual(sorted(name for name in set(METHODS) - exposed if not name.startswith(ABSENT)), [])

    def test_roles_are_known(self) -> None:
        """Every entry contains at least one role, and only existing roles."""
        for allowed in (*METHODS.values(), *KINDS.values(), roles.OTHER_METHODS):
            self.assertTrue(allowed)
            self.assertLessEqual(allowed, set(ROLES))

    def test_kinds_by_key(self) -> None:
        """The kind of a slot follows from its key, if the middleware or the page uses the key.

        The name of such a slot does not matter.
        """
        keys = {
            presence.DEVICES: roles.PRESENCE,
            tasks.TASKS: roles.TASKS,
            stop_state.STOPS_KEY: roles.HALT,
            manifests_key(): roles.DEPLOYMENTS,
            revocation.REVOKED_KEY: roles.SIGNED_OUT,
        }
        for key, kind in keys.items():
            for name in ("x", "order", "member"):
                self.assertEqual(classify_slot(slot(key, name)), kind)

    def test_presence_in_a_large_team(self) -> None:
        """In a large team a viewer can write its presence only under the directory prefixes of the viewer's id."""
        own, other = Identity(bytes(32)), Identity(b"1" * 32)
        for depth in range(presence.MAX_DEPTH + 1):
            for key in compute_places(own.node_id, depth):
                self.assertTrue(may_store([VIEWER], Slot(key, own.public, "phone")))
        strange = [key for key in compute_places(other.node_id, 9) if key not in compute_places(own.node_id, 9)]
        self.assertEqual([may_store([VIEWER], Slot(key, own.public, "phone")) for key in strange], [False] * 2)

    def test_kinds_by_name(self) -> None:
        """The slots of tasks and modules are recognized by their names; all other slots have the kind ``OTHER``."""
        key = tasks.group_key("t")
        names = {
            tasks.MEMBER: roles.MEMBER,
            tasks.RESULT: roles.RESULT,
            tasks.ORDER: roles.ORDER,
            tasks.COUNCIL: roles.COUNCIL,
            tasks.DONE: roles.ENDED,
            decision_record.make_slot_name(7): roles.DECISION_RECORD,
            deploy.SOURCE_SLOT: roles.SOURCE,
            "0": OTHER,
            "orders": OTHER,
            "": OTHER,
        }
        self.assertEqual({name: classify_slot(slot(key, name)) for name in names}, names)

    def test_a_viewer_changes_nothing(self) -> None:
        """A viewer publishes its presence and reads; it cannot act, send orders, bid or write other records."""
        writes = {kind for kind, allowed in KINDS.items() if VIEWER in allowed}
        self.assertEqual(writes, {roles.PRESENCE})
        for method in ("find_value", "watch", "device.settings", "device.inventory", "stream.open"):
            self.assertTrue(may_call((VIEWER,), method))
        for method in ("device.halt", "device.tune", "device.message", "lease.propose", "decree.claim", "made.up"):
            self.assertFalse(may_call((VIEWER,), method), method)

    def test_who_orders_and_who_acts(self) -> None:
        """Operators and gateways can send orders, devices and gateways can act.

        The role bootstrap alone permits neither.
        """
        for method in (
            "device.halt",
            "device.tune",
            "device.message",
            "device.disconnect",
            "device.fault",
            "lease.cancel",
        ):
            self.assertEqual([role for role in ROLES if may_call((role,), method)], [OPERATOR, GATEWAY])
        for method in ("lease.propose", "lease.close"):
            self.assertEqual([role for role in ROLES if may_call((role,), method)], [DEVICE, GATEWAY])
        for written in (slot(tasks.TASKS), slot(tasks.group_key("t"), tasks.RESULT), slot(stop_state.STOPS_KEY)):
            self.assertEqual([role for role in ROLES if may_store((role,), written)], [OPERATOR, GATEWAY])
        self.assertTrue(may_store((BOOTSTRAP,), slot(hash_key("tuples/admission/2"))))

    def test_several_roles_add_up(self) -> None:
        """A member with two roles has the rights of both roles; a member without roles has no rights."""
        self.assertTrue(may_call((VIEWER, OPERATOR), "device.halt"))
        self.assertFalse(may_call((), "ping"))
        self.assertFalse(may_store((), slot(presence.DEVICES)))


class TeamTests(SynchronousTestCase):
    def test_experiment_by_roles(self) -> None:
        """Experiment 2 passes with a gateway, two dogs as devices and a viewer, and no request is rejected."""
        plain: Any = SwarmNode
        known: dict[bytes, tuple[str, ...]] = {}
        refusals: list[tuple[tuple[str, ...], str]] = []

        def make(device: Any, identity: Identity, *rest: Any, **more: Any) -> Any:
            role = {"vaio": GATEWAY, "looker": VIEWER}.get(device.name, DEVICE)
            known[identity.public] = (role,)
            return plain(device, identity, *rest, **{**more, "admission": RoleAdmission(known, refusals)})

        self.patch(assembly, "SwarmNode", make)
        outcome = run_trial(partial(SimulatedTeam, others=("looker",)), 2, 3)
        # The council may include the viewer, whose role forbids ``lease.freed``.
        self.assertEqual(set(refusals) - {((VIEWER,), "lease.freed")}, set())
        self.assertEqual((outcome.broken, bool(outcome.found)), ([], True))
