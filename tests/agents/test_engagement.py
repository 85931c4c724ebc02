"""Tests of ``agents.engagement``: one agent's participation in one task, in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from twisted.internet.defer import Deferred, succeed
from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND
from agents.context import Context
from agents.engagement import SEARCH_TTL_S, Engagement, RobotCommand
from agents.state import Event
from drivers.driver import Permit
from drivers.reading import Action, Observation
from middleware.consensus.bidding.reporters import Reporters
from middleware.consensus.decision_record import DecisionRecord
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.lease.lease_client import Lease
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, ConsensusAlgorithm, Report
from middleware.directory.presence import ASSIGNED, DONE, EXECUTING, SEARCHING, WAITING
from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.tasks.order import PAUSE, RESUME, Order
from middleware.tasks.task import CANCELLED, COMPLETED, FAILED, Member, Result, Task

TASK = Task("t1", "find-target", "Find it", waiting_period=2.0)
LOOK, GO, HOLD = {"base.wz": 1.0}, {"base.vx": 0.1}, {"base.wz": 0.0}
ME = Identity(bytes([1]) * 32)
CONTACT = Contact(ME.public, Address("127.0.0.1", 7000))


class Dog:
    """A behaviour that completes after ``steps`` steps; the test sets its cost."""

    def __init__(self) -> None:
        self.cost: float | None = None
        self.steps = 10**6
        self.executed = 0
        self.is_safe = True
        self.progress: float | None = None
        self.valid_for = 0.0
        self.contexts: list[Context] = []

    def look(self, seen: Observation, now: float) -> None:
        """Read the cost from the observation."""
        value = seen.values["cost"]
        self.cost = None if isinstance(value, str) else float(value)

    def search(self, now: float) -> Action:
        """Return the search action."""
        return LOOK

    def hold(self, now: float) -> Action:
        """Return the hold action."""
        return HOLD

    def execute(self, context: Context) -> Action | None:
        """Return the next action, or None when done."""
        self.executed += 1
        self.contexts.append(context)
        return None if self.executed > self.steps else GO


class LeaseClientStub:
    """A stub of the lease client: the test grants the lease, and the calls are recorded."""

    def __init__(self, clock: HeapClock, events: list[str]) -> None:
        self.is_wanted = False
        self.standbys: Sequence[Contact] = ()
        self.rest = 0.0
        self.places: list[int] = []
        self.token = 0
        self.deadline = 0.0
        self._clock = clock
        self._events = events

    @property
    def lease(self) -> Lease | None:
        """Return the lease, or None if it is not valid."""
        held = self.token and self._clock.seconds() < self.deadline
        return Lease("t1", self.token, self.deadline) if held else None

    def claim(self) -> None:
        """Record that the agent claims the lease."""
        self.is_wanted = True

    def learn(self, packed: bytes) -> None:
        """Ignore the charter."""

    def stand_by(self, rank: int = 1) -> None:
        """Record the agent's rank among the standbys."""
        self.places.append(rank)

    def release(self, standbys: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[object]:
        """Return the lease."""
        self.standbys = standbys
        if self.token:
            self.rest = rest
            self._events.append("released")
        self.is_wanted, self.token = False, 0
        self.places.append(0)
        return succeed(None)

    def suspect_holder(self) -> None:
        """Record that the holder may have failed."""
        self._events.append("suspected")

    def change_council(self, members: Sequence[Contact]) -> Deferred[None]:
        """Record the change of the council, which ends the lease."""
        self._events.append(f"moved to {len(members)}")
        self.token = 0
        return succeed(None)

    def grant(self, token: int, ttl: float = 1.5) -> None:
        """Grant the lease."""
        self.token, self.deadline = token, self._clock.seconds() + ttl


class Recorder:
    """The outputs of an engagement; all of them are recorded."""

    def __init__(self, events: list[str]) -> None:
        self.reports: list[Member] = []
        self.results: list[Result] = []
        self.log_lines: list[str] = []
        self.decision_records: list[DecisionRecord] = []
        self.known: dict[str, Contact] = {}
        self.moves_for = 0.0
        self._events = events

    def publish_report(self, member: Member) -> None:
        """Record a report."""
        self.reports.append(member)

    def record_outcome(self, result: Result) -> None:
        """Record an outcome."""
        self.results.append(result)

    def log_event(self, text: str) -> None:
        """Record a log line."""
        self.log_lines.append(text)

    def publish_decision_record(self, record: DecisionRecord) -> None:
        """Record a decision record."""
        self.decision_records.append(record)

    def stop_robot(self) -> float:
        """Record the stop; without a connection it does not reach the robot."""
        self._events.append("halted")
        return self.moves_for

    def find_contacts(self, uuids: Sequence[str]) -> Sequence[Contact]:
        """Return the known contacts of these agents."""
        return [self.known[uuid] for uuid in uuids if uuid in self.known]


class EngagementTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.events: list[str] = []
        self.outputs = Recorder(self.events)
        self.reports, self.results, self.log_lines = self.outputs.reports, self.outputs.results, self.outputs.log_lines
        self.dog = Dog()
        self.lease_client = LeaseClientStub(self.clock, self.events)
        self.others = {n: Identity(bytes([n]) * 32) for n in (2, 3)}
        self.begin(TASK)

    def begin(self, task: Task, strategy: ConsensusAlgorithm | None = None) -> None:
        """Take part in ``task`` with the robot."""
        uuid = ME.node_id.hex()
        me, reporters, now = Member(uuid, "dog1", ""), Reporters(uuid), self.clock.seconds()
        self.engagement = Engagement(task, me, self.dog, strategy or Nearest(), self.outputs, reporters, 4, now)
        self.engagement.take_robot(self.lease_client, 4)  # type: ignore[arg-type]

    def report(self, number: int, cost: float | None, status: str = WAITING) -> Member:
        """Return a report of another dog."""
        return Member(self.others[number].node_id.hex(), f"dog{number}", status, cost)

    def hear(self, *members: Member) -> None:
        """Deliver these reports on the open task."""
        self.engagement.process_reports(list(members), None, self.clock.seconds())

    def end(self, outcome: str, by: str) -> None:
        """Deliver the outcome of the task."""
        self.engagement.process_reports([], Result(outcome, by, 1.0, 5), self.clock.seconds())

    def see(self, cost: float | None) -> None:
        """Deliver an observation that gives this cost."""
        seen = Observation(0.0, 0.0, {"cost": "none" if cost is None else cost})
        self.engagement.look(seen, self.clock.seconds())

    def step(self) -> RobotCommand:
        """Run one step that must return an action."""
        command = self.engagement.step(self.clock.seconds())
        assert command is not None
        return command

    def acting(self, token: int = 5) -> None:
        """Make the agent act: it is the nearest of two and has the lease."""
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.step()
        self.lease_client.grant(token)
        self.assertEqual(self.step().action, GO)

    def test_states_follow_the_thesis(self) -> None:
        """The status is ASSIGNED, then SEARCHING, WAITING after the report, EXECUTING with the lease, and DONE."""
        self.assertEqual(self.engagement.me.status, ASSIGNED)
        self.hear(self.report(2, None))
        self.assertEqual(self.step().action, LOOK)
        self.see(1.0)
        self.assertEqual(self.step().action, HOLD)
        self.hear(self.report(2, 2.0))
        self.step()
        self.lease_client.grant(5)
        self.assertEqual(self.step().action, GO)
        self.end(COMPLETED, "dog1")
        statuses = list(dict.fromkeys(member.status for member in self.reports))
        self.assertEqual(statuses, [SEARCHING, WAITING, EXECUTING, DONE])

    def test_nothing_is_executed_without_a_lease(self) -> None:
        """The assigned agent does not move before the quorum grants the lease, and stops when the lease expires."""
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        for _ in range(5):
            self.assertEqual(self.step().action, HOLD)
            self.clock.advance(0.05)
        self.assertTrue(self.lease_client.is_wanted)
        self.assertEqual(self.dog.executed, 0)
        self.lease_client.grant(5)
        command = self.step()
        self.assertEqual(
            (command.action, command.permit.token, command.permit.deadline), (GO, 5, self.lease_client.deadline)
        )
        self.clock.advance(1.6)
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted"])

    def test_looking_around_is_permitted_for_a_moment_only(self) -> None:
        """A search motion without a lease carries the highest token that the robot accepted, and a short deadline."""
        permit = self.step().permit
        self.assertEqual((permit.token, permit.deadline), (4, self.clock.seconds() + SEARCH_TTL_S))

    def test_body_stops_before_the_lease_goes_back(self) -> None:
        """When a better report takes the task away, the agent stops the robot before it returns the lease."""
        self.acting()
        self.hear(self.report(2, 0.5))
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted", "released"])
        self.assertIn("releases the task", self.log_lines)

    def test_who_stands_by_keeps_its_place(self) -> None:
        """A standby keeps its rank among the standbys from its first step onwards."""
        self.hear(self.report(2, 0.5, EXECUTING))
        self.see(1.0)
        for _ in range(5):
            self.assertEqual(self.step().action, HOLD)
            self.clock.advance(0.05)
        self.assertEqual(self.lease_client.places, [1] * 5)

    def test_who_is_to_act_and_does_not_yet_is_in_the_line(self) -> None:
        """An assigned agent that does not act yet is the first standby, so two agents never claim simultaneously."""
        self.hear(self.report(2, 0.5))
        self.see(1.0)
        self.step()
        self.assertEqual(self.lease_client.places, [2])
        self.hear(self.report(2, 0.5, EXECUTING))
        self.step()
        self.assertEqual(self.lease_client.places, [2, 1])

    def test_who_is_not_let_insists(self) -> None:
        """An assigned agent without a lease repeats its report every second.

        Otherwise other agents would consider it failed.
        """
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.step()
        count = len(self.reports)
        for _ in range(50):
            self.clock.advance(0.05)
            self.step()
        again = self.reports[count - 1 :]
        self.assertEqual([member.serial - again[0].serial for member in again], [0, 1, 2])
        self.assertEqual({(member.cost, member.assigned) for member in again}, {(1.0, ME.node_id.hex())})

    def test_who_was_passed_over_is_let_again(self) -> None:
        """A standby that was granted the lease returns it when the agent that it replaced sends its next report."""
        better = self.report(2, 0.5)
        self.hear(better)
        self.see(1.0)
        self.step()
        self.lease_client.grant(5)
        self.assertEqual(self.step().action, GO)
        for _ in range(5):
            self.clock.advance(0.05)
            self.assertEqual(self.step().action, GO)
        self.hear(replace(better, serial=1))
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted", "released"])

    def test_member_that_left_is_decided_without(self) -> None:
        """When the assigned agent leaves the group, the next agent claims the lease in its next step."""
        self.hear(self.report(2, 0.5, EXECUTING), self.report(3, 3.0))
        self.see(1.0)
        self.step()
        self.assertEqual((self.lease_client.is_wanted, self.events), (False, []))
        self.hear(self.report(3, 3.0))
        self.assertEqual(self.events, ["suspected"])
        self.step()
        self.assertTrue(self.lease_client.is_wanted)

    def test_council_changes_under_who_acts(self) -> None:
        """At a safe point the acting agent stops, the council is replaced, and the agent continues with a new lease."""
        self.acting()
        self.dog.is_safe = False
        self.engagement.schedule_council_change([CONTACT] * 3)
        self.assertEqual((self.step().action, self.events), (GO, []))
        self.dog.is_safe = True
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual(self.events, ["halted", "moved to 3"])
        self.clock.advance(0.2)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual(self.reports[-1].status, EXECUTING)
        self.lease_client.grant(9)
        self.assertEqual(self.step(), RobotCommand(GO, Permit(9, self.lease_client.deadline)))
        self.assertEqual(self.events, ["halted", "moved to 3"])

    def test_moved_target_is_reported_again(self) -> None:
        """A larger cost is reported again in every state.

        A smaller cost is reported only by an agent that does not act.
        """
        self.see(1.0)
        self.see(1.1)
        self.assertEqual([m.cost for m in self.reports], [1.0])
        self.see(1.5)
        self.see(0.6)
        self.assertEqual([m.cost for m in self.reports], [1.0, 1.5, 0.6])
        self.hear(self.report(2, 2.0))
        self.step()
        self.lease_client.grant(5)
        self.step()
        self.see(0.1)
        self.assertEqual(self.engagement.me.cost, 0.6)
        self.see(1.9)
        self.assertEqual(self.engagement.me.cost, 1.9)

    def test_lost_body_may_still_move(self) -> None:
        """An agent that cannot stop its robot returns the lease and states for how long the robot may still move."""
        for leave in (lambda: self.engagement.on_robot_lost(), lambda: self.engagement.leave(self.clock.seconds())):
            self.setUp()
            self.acting()
            self.outputs.moves_for = 0.8
            leave()
            self.engagement.step(self.clock.seconds())
            self.assertEqual(self.lease_client.rest, 0.8)

    def test_lost_body_is_not_waited_for(self) -> None:
        """An agent without a connection to its robot is unavailable until the next observation."""
        for cost in (None, 1.0):
            self.see(cost)
            self.engagement.on_robot_lost()
            self.assertEqual((self.reports[-1].cost, self.reports[-1].available), (None, False), str(cost))
            self.see(cost)
            self.assertEqual((self.reports[-1].cost, self.reports[-1].available), (cost, True), str(cost))

    def test_done_is_recorded_and_the_lease_kept_until_it_is_known(self) -> None:
        """The agent stops, records the outcome once, and returns the lease after the outcome is confirmed."""
        self.dog.steps = 1
        self.acting()
        command = self.step()
        self.assertEqual((command.action, command.permit.token), (STAND, 5))
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual([(r.outcome, r.by, r.token) for r in self.results], [(COMPLETED, "dog1", 5)])
        self.assertEqual(self.results[0].bids, (("dog1", 1.0), ("dog2", 2.0)))
        self.assertEqual(self.events, ["halted"])
        self.end(COMPLETED, "dog1")
        self.engagement.leave(self.clock.seconds())
        self.assertEqual(self.events[-1], "released")

    def test_task_changes_hands_at_safe_points_only(self) -> None:
        """A better report takes effect at the next safe point of the behaviour."""
        self.acting()
        self.dog.is_safe = False
        self.hear(self.report(2, 0.5))
        self.assertEqual(self.step().action, GO)
        self.dog.is_safe = True
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted", "released"])

    def test_pause_and_resume(self) -> None:
        """On a pause the agent stops the robot and returns the lease; after the resume the behaviour continues."""
        self.acting()
        self.engagement.process_order(Order(PAUSE, "vaio", 1.0))
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual(self.events, ["halted", "released"])
        self.assertEqual((self.engagement.me.cost, self.engagement.me.available), (None, False))
        self.see(0.9)
        self.assertIsNone(self.engagement.me.cost)
        self.engagement.process_order(Order(RESUME, "vaio", 2.0))
        self.see(0.9)
        self.hear(self.report(2, 2.0))
        self.step()
        self.lease_client.grant(6)
        self.assertEqual(self.step().action, GO)
        self.assertEqual(self.log_lines[-3:], ["resumed by vaio", "reports 0.90 m", "acts: dog1, 0.90, best of 2"])

    def test_lease_is_kept_while_the_outcome_is_on_its_way(self) -> None:
        """The agent keeps the lease until the outcome is recorded, even if another task arrives after completion."""
        self.dog.steps = 1
        self.acting()
        self.step()
        self.assertFalse(self.engagement.can_yield_robot)
        self.engagement.yield_robot("busy with T", self.clock.seconds())
        self.assertEqual(self.events, ["halted"])
        self.end(COMPLETED, "dog1")
        self.engagement.leave(self.clock.seconds())
        self.assertEqual(self.events, ["halted", "released"])

    def test_deadline_fails_the_task_once(self) -> None:
        """The agent that acts at the task's deadline records once that the task has failed."""
        self.begin(replace(TASK, deadline=5.0))
        self.acting()
        self.clock.advance(5.1)
        self.lease_client.grant(5)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual([(r.outcome, r.why) for r in self.results], [(FAILED, "past its deadline of 5 s")])

    def test_deadline_falls_to_one(self) -> None:
        """An idle agent records the missed deadline only if no agent acts and the idle agent has the lowest uuid."""
        self.begin(replace(TASK, deadline=5.0))
        self.clock.advance(5.1)
        lowest = min([ME, *self.others.values()], key=lambda one: one.node_id.hex())
        self.hear(self.report(2, 1.0, EXECUTING))
        self.step()
        self.assertEqual(self.results, [])
        self.hear(self.report(2, 1.0), self.report(3, 1.0))
        self.engagement.step(self.clock.seconds())
        self.assertEqual(len(self.results), int(lowest is ME))

    def test_deadline_is_told_by_who_holds_the_task(self) -> None:
        """An agent that ends a task on which no agent acts first claims the lease, whose token the outcome needs."""
        self.begin(replace(TASK, deadline=5.0))
        self.patch(self.engagement._decider, "is_first", lambda now: True)
        self.acting()
        self.clock.advance(5.1)
        for _ in range(2):
            self.assertIsNone(self.engagement.step(self.clock.seconds()))
            self.assertEqual((self.results, self.lease_client.is_wanted), ([], True))
        self.lease_client.grant(6)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual([result.token for result in self.results], [6])

    def test_higher_token_reopens_the_task(self) -> None:
        """If an agent that records an outcome learns of a higher token, it takes part in the task again."""
        self.dog.steps = 1
        self.acting()
        self.step()
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.engagement.apply_event(Event.REOPENED, self.clock.seconds())
        self.assertEqual(self.events[-1], "released")
        self.assertIsNotNone(self.engagement.step(self.clock.seconds()))

    def test_no_progress_gives_the_task_to_another(self) -> None:
        """An agent without progress within the stall limit returns the lease, and pauses bidding for the same time."""
        self.begin(replace(TASK, stall_limit=1.0))
        self.dog.progress = 0.5
        self.acting()
        for _ in range(22):
            self.clock.advance(0.05)
            self.lease_client.grant(5)
            self.step()
        self.assertEqual(self.events[:2], ["halted", "released"])
        self.assertIn("makes no progress", self.log_lines)
        self.see(0.5)
        self.assertIsNone(self.engagement.me.cost)
        self.clock.advance(1.2)
        self.see(0.5)
        self.assertEqual(self.engagement.me.cost, 0.5)

    def test_behaviour_that_bids_nonsense_bids_nothing(self) -> None:
        """NaN, infinite, negative and too large costs are never reported."""
        for cost in (float("nan"), float("inf"), -1.0, 1e300):
            self.see(cost)
            self.assertIsNone(self.engagement.me.cost)

    def test_validity_is_renewed(self) -> None:
        """A bid with a validity period is renewed under a new serial number before it expires."""
        self.dog.valid_for = 2.0
        self.see(1.0)
        self.clock.advance(1.1)
        self.see(1.0)
        self.assertEqual([(m.cost, m.serial, m.valid_for) for m in self.reports], [(1.0, 1, 2.0), (1.0, 2, 2.0)])

    def test_failing_strategy_falls_back_to_nearest(self) -> None:
        """The error of a failing strategy is logged once, and the nearest agent is assigned."""

        class Broken(Nearest):
            name = "broken"

            def find(self, contacts: Sequence[Report]) -> Consensus:
                """Fail."""
                raise ZeroDivisionError("no luck")

        self.begin(TASK, GuardedStrategy(Broken()))
        self.hear(self.report(2, 0.5))
        self.see(1.0)
        self.step()
        self.step()
        faults = [line for line in self.log_lines if "broken" in line and not line.startswith("standby")]
        self.assertEqual(faults, ["broken failed (ZeroDivisionError: no luck); nearest: cost 0.50, the lowest of 2"])
        self.assertEqual(self.engagement.me.assigned, self.others[2].node_id.hex())
        self.assertEqual(len(self.flushLoggedErrors(ZeroDivisionError)), 1)

    def test_outcome_absorbs_what_follows(self) -> None:
        """No event restarts an ended task; if two outcomes are known, COMPLETED with a token takes precedence."""
        self.end(CANCELLED, "vaio")
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertTrue(self.engagement.is_over)
        self.engagement.process_reports([], Result(COMPLETED, "dog2", 1.0, 9), self.clock.seconds())
        self.assertEqual(self.engagement.result, Result(COMPLETED, "dog2", 1.0, 9))
        self.engagement.process_reports([], Result(CANCELLED, "vaio"), self.clock.seconds())
        self.assertEqual(self.engagement.result, Result(COMPLETED, "dog2", 1.0, 9))

    def test_older_life_is_counted_on(self) -> None:
        """After a restart the agent continues the round and serial numbers of its previous run."""
        self.hear(Member(ME.node_id.hex(), "dog1", WAITING, 9.0, epoch=4, serial=3))
        self.see(1.0)
        self.assertGreater((self.reports[-1].epoch, self.reports[-1].serial), (4, 3))

    def test_heirs_hear_of_a_leave_from_the_one_that_leaves(self) -> None:
        """An agent that leaves a task passes the ordered list of standbys, without itself, to the lease client."""
        contacts = {n: Contact(each.public, Address("10.0.0.1", n)) for n, each in self.others.items()}
        self.outputs.known = {contact.node_id.hex(): contact for contact in contacts.values()}
        self.hear(self.report(2, 3.0), self.report(3, 2.0))
        self.see(1.0)
        self.step()
        self.lease_client.grant(1)
        self.step()
        self.engagement.leave(self.clock.seconds())
        self.assertEqual(self.lease_client.standbys, [contacts[3], contacts[2]])

    def test_each_decision_is_accounted_for_once(self) -> None:
        """A new decision is recorded immediately.

        A decision with changed reports is recorded at most once per second; an unchanged decision is not recorded
        again.
        """
        records = self.outputs.decision_records
        self.step()
        self.assertEqual(records, [])
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.step()
        self.assertEqual([(v.winner, v.epoch, v.token) for v in records], [(ME.node_id.hex(), 1, 0)])
        self.assertEqual([(r.name, r.cost) for r in records[0].reports], [("dog1", 1.0), ("dog2", 2.0)])
        for cost in (2.1, 2.2, 2.3, 2.4):
            self.hear(self.report(2, cost))
            self.clock.advance(0.1)
            self.step()
        self.assertEqual(len(records), 1)
        self.clock.advance(1.0)
        self.step()
        self.assertEqual(records[1].reports[1].cost, 2.4)
        self.clock.advance(5.0)
        self.step()
        self.assertEqual(len(records), 2)
