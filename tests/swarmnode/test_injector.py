"""Tests of ``middleware.faults.injector``: an injected fault reaches its device, takes effect, and ends."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import parse_devices
from middleware.faults.injector import TRANSITIONS, State
from middleware.faults.kinds import CAUSE_METHOD, KINDS, LIST_METHOD, Fault
from middleware.faults.takeover import TARGET_S, Takeover, find_executing
from swarmnode.control_client import Rejection
from swarmnode.simulated_team import SimulatedStage, SimulatedTeam


class InjectorTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.stage = SimulatedStage(3)
        self.addCleanup(self.stage.stop)

    def named(self, name: str) -> Any:
        return next(device for device in self.stage.devices() if device.name == name)

    def asked(self, name: str) -> dict[str, Any]:
        told: dict[str, Any] = self.stage._call(self.named(name), LIST_METHOD)
        return told

    def turn(self) -> tuple[Any, str]:
        """Return the task and its acting device, shortly after that device has begun to act."""
        task = self.stage.assign("turn-around")
        for _ in range(100):
            self.stage.wait(0.05)
            acts = find_executing(self.stage.devices())
            if acts:
                self.stage.wait(0.4)
                return next(each for each in self.stage.devices() if each.uuid in acts), task
        self.fail("nobody ever acted")

    def takeover(self, fault: Fault) -> Takeover:
        """Inject a fault into the acting device; return the takeover when it has ended or reached its time limit."""
        lost, task = self.turn()
        self.stage.inject(lost, fault)
        now = self.stage.seconds()
        clock = Takeover(lost.uuid, task, now, now + fault.seconds)
        while clock.is_open(self.stage.seconds()) and not self.stage.is_over(task):
            self.stage.wait(0.05)
            clock.observe(find_executing(self.stage.devices()), self.stage.seconds())
        return clock

    def test_takeover(self) -> None:
        """An acting device that is killed, frozen, disconnected, muted or without battery is replaced within 2 s."""
        for kind in ("kill", "freeze", "radio", "one-way", "battery"):
            self.assertTrue(KINDS[kind].is_lost)
            clock = self.takeover(Fault(kind, 4.0, KINDS[kind].amount))
            assert clock.seconds is not None, kind
            self.assertLessEqual(clock.seconds, TARGET_S, kind)
            self.stage.wait(25.0)  # all devices have returned
            self.assertEqual(len(self.stage.devices()), 4, kind)

    def test_skew_changes_nothing(self) -> None:
        """A device with a clock that is wrong by a day finishes its task; only the times in its log are wrong."""
        clock = self.takeover(Fault("skew", 30.0, 86400.0))
        self.assertIsNone(clock.seconds)
        self.stage.wait(1.0)
        device = next(each for each in self.stage.devices() if each.uuid == clock.lost)
        self.assertGreater(device.messages[-1][0], 86400.0)

    def test_heal(self) -> None:
        """A fault ends after its duration; a repeated fault starts again with its new values; other faults continue."""
        dog = self.named("dog1")
        self.stage.inject(dog, Fault("delay", 2.0, 0.05))
        self.stage.inject(dog, Fault("loss", 20.0, 0.01))
        self.stage.wait(1.5)
        self.stage.inject(dog, Fault("delay", 3.0, 0.1))
        self.stage.wait(1.0)
        active = {kind: (left, amount) for kind, left, amount in self.asked("dog1")["active"]}
        self.assertEqual(active["delay"][1], 0.1)
        self.assertTrue(1.0 < active["delay"][0] < 2.5, active)
        self.stage.wait(2.5)
        self.assertEqual([kind for kind, _, _ in self.asked("dog1")["active"]], ["loss"])

    def test_cut_off_and_back(self) -> None:
        """A device with a radio that is off leaves the team, and returns after the fault."""
        self.stage.inject(self.named("dog2"), Fault("radio", 4.0))
        self.stage.wait(3.0)
        self.assertEqual([device.name for device in self.stage.devices()], ["vaio", "dog1", "dog3"])
        self.stage.wait(5.0)
        self.assertIn("dog2", [device.name for device in self.stage.devices()])

    def test_battery_of_idle_dogs(self) -> None:
        """Dogs with drained batteries take no task until the batteries are charged again."""
        for name in ("dog1", "dog2", "dog3"):
            self.stage.inject(self.named(name), Fault("battery", 4.0, 0.02))
        self.stage.wait(0.6)
        self.stage.assign("turn-around")
        for _ in range(30):
            self.stage.wait(0.1)
            self.assertEqual(find_executing(self.stage.devices()), {})
        self.stage.wait(3.0)
        self.assertEqual(len(find_executing(self.stage.devices())), 1)

    def test_what_can_be_suffered(self) -> None:
        """A laptop cannot have a battery fault; unsupported faults and invalid values are rejected with a reason."""
        self.assertEqual(self.asked("vaio")["kinds"], [kind for kind in KINDS if kind != "battery"])
        self.assertEqual(self.asked("dog1")["kinds"], list(KINDS))
        error = self.assertRaises(Rejection, self.stage.inject, self.named("vaio"), Fault("battery", 5.0, 0.01))
        self.assertIn("does not support battery; choose one of kill, freeze", str(error))
        error = self.assertRaises(Rejection, self.stage.inject, self.named("dog1"), Fault("radio", 1e9))
        self.assertIn("seconds", str(error))
        error = self.assertRaises(Rejection, self.stage.assign, "fly")
        self.assertIn("turn-around", str(error))


class TransitionTests(SynchronousTestCase):
    def test_every_order_ends(self) -> None:
        """Every state of an injected fault has a sequence of events that leads to OVER, which is final."""
        for state in State:
            reached, left = {state}, [state]
            while left:
                here = left.pop()
                after = {there for (source, _), there in TRANSITIONS.items() if source is here} - reached
                reached |= after
                left += after
            self.assertIn(State.OVER, reached)
        self.assertEqual({there for (source, _), there in TRANSITIONS.items() if source is State.OVER}, {State.OVER})


class ForbiddenTests(SynchronousTestCase):
    def test_nothing_where_not_allowed(self) -> None:
        """A node that does not allow faults rejects the method, and its network is not affected."""
        team = SimulatedTeam(3, dogs=("dog1",))
        self.addCleanup(team.stop)
        node = team.services["vaio"].assembly.node
        watch = node.watch_devices(lambda records: None)
        team.clock.advance(2.0)
        contact = next(node.find_contact(r) for device, r in parse_devices(watch.records) if device.name == "dog1")
        assert contact is not None
        work = node.entangled.call(contact, CAUSE_METHOD, "radio", 5.0, None, changes=True)
        problems: list[str] = []
        work.addErrback(lambda failure: problems.append(failure.getErrorMessage()))
        team.clock.advance(4.0)
        self.assertEqual(len(problems), 1)
        self.assertEqual(len(parse_devices(watch.records)), 2)
