"""Tests of ``agents.engagement``: one agent's part in one task, on a turned clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from twisted.internet.defer import Deferred, succeed
from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND
from agents.context import Context
from agents.engagement import SEARCH_TTL, Deed, Engagement
from agents.state import Event
from drivers.driver import Permit
from drivers.reading import Action, Observation
from middleware.consensus.bidding.panel import Panel
from middleware.consensus.guard import Guard
from middleware.consensus.lease.lessee import Lease
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, ConsensusAlgorithm, Report
from middleware.consensus.verdict import Verdict
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
    """A behaviour whose body tells the cost that the test says, and needs ``steps`` steps to be done."""

    def __init__(self) -> None:
        self.cost: float | None = None
        self.steps = 10**6
        self.executed = 0
        self.is_safe = True
        self.progress: float | None = None
        self.valid_for = 0.0
        self.contexts: list[Context] = []

    def look(self, seen: Observation, now: float) -> None:
        """Take the cost from the observation."""
        value = seen.values["cost"]
        self.cost = None if isinstance(value, str) else float(value)

    def search(self, now: float) -> Action:
        """Look around."""
        return LOOK

    def hold(self, now: float) -> Action:
        """Stand."""
        return HOLD

    def execute(self, context: Context) -> Action | None:
        """Go on, from where it was."""
        self.executed += 1
        self.contexts.append(context)
        return None if self.executed > self.steps else GO


class Council:
    """The lessee's side of a council that grants when the test says so, and writes down what happens."""

    def __init__(self, clock: HeapClock, events: list[str]) -> None:
        self.is_wanted = False
        self.heirs: Sequence[Contact] = ()
        self.rest = 0.0
        self.places: list[int] = []
        self.token = 0
        self.deadline = 0.0
        self._clock = clock
        self._events = events

    @property
    def lease(self) -> Lease | None:
        """The lease while it is valid."""
        held = self.token and self._clock.seconds() < self.deadline
        return Lease("t1", self.token, self.deadline) if held else None

    def want(self) -> None:
        """Note the wish."""
        self.is_wanted = True

    def learn(self, packed: bytes) -> None:
        """It is the council."""

    def stand_by(self, rank: int = 1) -> None:
        """Note the place in the line."""
        self.places.append(rank)

    def release(self, heirs: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[object]:
        """Give it back."""
        self.heirs = heirs
        if self.token:
            self.rest = rest
            self._events.append("released")
        self.is_wanted, self.token = False, 0
        self.places.append(0)
        return succeed(None)

    def suspect(self) -> None:
        """Note that the holder may be gone."""
        self._events.append("suspected")

    def move(self, members: Sequence[Contact]) -> Deferred[None]:
        """Note that there is to be another council; the lease goes back with it."""
        self._events.append(f"moved to {len(members)}")
        self.token = 0
        return succeed(None)

    def grant(self, token: int, ttl: float = 1.5) -> None:
        """Let the agent have it."""
        self.token, self.deadline = token, self._clock.seconds() + ttl


class Recorder:
    """The ways out of an engagement, which write down what goes out."""

    def __init__(self, events: list[str]) -> None:
        self.told: list[Member] = []
        self.results: list[Result] = []
        self.said: list[str] = []
        self.accounts: list[Verdict] = []
        self.known: dict[str, Contact] = {}
        self.moves_for = 0.0
        self._events = events

    def tell(self, member: Member) -> None:
        """Keep a report."""
        self.told.append(member)

    def conclude(self, result: Result) -> None:
        """Keep an outcome."""
        self.results.append(result)

    def say(self, text: str) -> None:
        """Keep a line."""
        self.said.append(text)

    def justify(self, verdict: Verdict) -> None:
        """Keep an account."""
        self.accounts.append(verdict)

    def halt(self) -> float:
        """Stop the body, which may not hear it."""
        self._events.append("halted")
        return self.moves_for

    def reached(self, uuids: Sequence[str]) -> Sequence[Contact]:
        """How agents are reached."""
        return [self.known[uuid] for uuid in uuids if uuid in self.known]


class EngagementTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.events: list[str] = []
        self.ports = Recorder(self.events)
        self.told, self.results, self.said = self.ports.told, self.ports.results, self.ports.said
        self.dog = Dog()
        self.council = Council(self.clock, self.events)
        self.others = {n: Identity(bytes([n]) * 32) for n in (2, 3)}
        self.begin(TASK)

    def begin(self, task: Task, strategy: ConsensusAlgorithm | None = None) -> None:
        """Take part in ``task``, with the body."""
        uuid = ME.node_id.hex()
        me, panel, now = Member(uuid, "dog1", ""), Panel(uuid), self.clock.seconds()
        self.engagement = Engagement(task, me, self.dog, strategy or Nearest(), self.ports, panel, 4, now)
        self.engagement.take_body(self.council, 4)  # type: ignore[arg-type]

    def report(self, number: int, cost: float | None, status: str = WAITING) -> Member:
        """What another dog reports."""
        return Member(self.others[number].node_id.hex(), f"dog{number}", status, cost)

    def hear(self, *members: Member) -> None:
        """Let the group tell who is present, while the task is open."""
        self.engagement.heard(list(members), None, self.clock.seconds())

    def end(self, outcome: str, by: str) -> None:
        """Let the group tell how the task ended."""
        self.engagement.heard([], Result(outcome, by, 1.0, 5), self.clock.seconds())

    def see(self, cost: float | None) -> None:
        """Let the body measure."""
        seen = Observation(0.0, 0.0, {"cost": "none" if cost is None else cost})
        self.engagement.look(seen, self.clock.seconds())

    def step(self) -> Deed:
        """One step that has to give a deed."""
        deed = self.engagement.step(self.clock.seconds())
        assert deed is not None
        return deed

    def acting(self, token: int = 5) -> None:
        """Bring the agent to where it acts: nearest of two, lease granted."""
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.step()
        self.council.grant(token)
        self.assertEqual(self.step().action, GO)

    def test_states_follow_the_thesis(self) -> None:
        """An agent is ASSIGNED, SEARCHING until it can report, then WAITING, EXECUTING with the lease, DONE."""
        self.assertEqual(self.engagement.me.status, ASSIGNED)
        self.hear(self.report(2, None))
        self.assertEqual(self.step().action, LOOK)
        self.see(1.0)
        self.assertEqual(self.step().action, HOLD)
        self.hear(self.report(2, 2.0))
        self.step()
        self.council.grant(5)
        self.assertEqual(self.step().action, GO)
        self.end(COMPLETED, "dog1")
        statuses = list(dict.fromkeys(member.status for member in self.told))
        self.assertEqual(statuses, [SEARCHING, WAITING, EXECUTING, DONE])

    def test_nothing_is_executed_without_a_lease(self) -> None:
        """The one that should act only stands by until the council grants, and again when the lease has run out."""
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        for _ in range(5):
            self.assertEqual(self.step().action, HOLD)
            self.clock.advance(0.05)
        self.assertTrue(self.council.is_wanted)
        self.assertEqual(self.dog.executed, 0)
        self.council.grant(5)
        deed = self.step()
        self.assertEqual((deed.action, deed.permit.token, deed.permit.deadline), (GO, 5, self.council.deadline))
        self.clock.advance(1.6)
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted"])

    def test_looking_around_is_permitted_for_a_moment_only(self) -> None:
        """A motion that needs no lease carries the highest token that the body obeyed, and a short deadline."""
        permit = self.step().permit
        self.assertEqual((permit.token, permit.deadline), (4, self.clock.seconds() + SEARCH_TTL))

    def test_body_stops_before_the_lease_goes_back(self) -> None:
        """When a better report takes the task away, the body is stopped first and the lease is given back after."""
        self.acting()
        self.hear(self.report(2, 0.5))
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted", "released"])
        self.assertIn("releases the task", self.said)

    def test_who_stands_by_keeps_its_place(self) -> None:
        """Who only waits, and holds nothing, stays in the line from its first step on and never goes to its end."""
        self.hear(self.report(2, 0.5, EXECUTING))
        self.see(1.0)
        for _ in range(5):
            self.assertEqual(self.step().action, HOLD)
            self.clock.advance(0.05)
        self.assertEqual(self.council.places, [1] * 5)

    def test_who_is_to_act_and_does_not_yet_is_in_the_line(self) -> None:
        """Whom the first in line waits for acts already, or is the one before it: they never claim at one moment."""
        self.hear(self.report(2, 0.5))
        self.see(1.0)
        self.step()
        self.assertEqual(self.council.places, [2])
        self.hear(self.report(2, 0.5, EXECUTING))
        self.step()
        self.assertEqual(self.council.places, [2, 1])

    def test_who_is_not_let_insists(self) -> None:
        """Who is to act, and has no lease, says so again each second; nobody can take it for one that gave up."""
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.step()
        told = len(self.told)
        for _ in range(50):
            self.clock.advance(0.05)
            self.step()
        again = self.told[told - 1 :]
        self.assertEqual([member.serial - again[0].serial for member in again], [0, 1, 2])
        self.assertEqual({(member.cost, member.assigned) for member in again}, {(1.0, ME.node_id.hex())})

    def test_who_was_passed_over_is_let_again(self) -> None:
        """Who got the lease while it stood by gives way to the better one as soon as that says anything."""
        better = self.report(2, 0.5)
        self.hear(better)
        self.see(1.0)
        self.step()
        self.council.grant(5)
        self.assertEqual(self.step().action, GO)
        for _ in range(5):
            self.clock.advance(0.05)
            self.assertEqual(self.step().action, GO)
        self.hear(replace(better, serial=1))
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted", "released"])

    def test_member_that_left_is_decided_without(self) -> None:
        """When the assigned agent disappears, the next one claims the lease at its next step."""
        self.hear(self.report(2, 0.5, EXECUTING), self.report(3, 3.0))
        self.see(1.0)
        self.step()
        self.assertEqual((self.council.is_wanted, self.events), (False, []))
        self.hear(self.report(3, 3.0))
        self.assertEqual(self.events, ["suspected"])
        self.step()
        self.assertTrue(self.council.is_wanted)

    def test_council_changes_under_who_acts(self) -> None:
        """It stands still before the council changes, stays the one that acts, and goes on with its new lease."""
        self.acting()
        self.dog.is_safe = False
        self.engagement.hand_council([CONTACT] * 3)
        self.assertEqual((self.step().action, self.events), (GO, []))
        self.dog.is_safe = True
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual(self.events, ["halted", "moved to 3"])
        self.clock.advance(0.2)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual(self.told[-1].status, EXECUTING)
        self.council.grant(9)
        self.assertEqual(self.step(), Deed(GO, Permit(9, self.council.deadline)))
        self.assertEqual(self.events, ["halted", "moved to 3"])

    def test_moved_target_is_reported_again(self) -> None:
        """A distance that grew is reported anew by everybody; one that shrank only by those that do not walk."""
        self.see(1.0)
        self.see(1.1)
        self.assertEqual([m.cost for m in self.told], [1.0])
        self.see(1.5)
        self.see(0.6)
        self.assertEqual([m.cost for m in self.told], [1.0, 1.5, 0.6])
        self.hear(self.report(2, 2.0))
        self.step()
        self.council.grant(5)
        self.step()
        self.see(0.1)
        self.assertEqual(self.engagement.me.cost, 0.6)
        self.see(1.9)
        self.assertEqual(self.engagement.me.cost, 1.9)

    def test_lost_body_may_still_move(self) -> None:
        """With the lease of a robot that does not hear that it is to stop goes back for how long it still moves."""
        for leave in (lambda: self.engagement.lose_body(), lambda: self.engagement.abandon(self.clock.seconds())):
            self.setUp()
            self.acting()
            self.ports.moves_for = 0.8
            leave()
            self.engagement.step(self.clock.seconds())
            self.assertEqual(self.council.rest, 0.8)

    def test_lost_body_is_not_waited_for(self) -> None:
        """Whose robot does not answer is not free, whether it had reported or not; at the next look it is again."""
        for cost in (None, 1.0):
            self.see(cost)
            self.engagement.lose_body()
            self.assertEqual((self.told[-1].cost, self.told[-1].available), (None, False), str(cost))
            self.see(cost)
            self.assertEqual((self.told[-1].cost, self.told[-1].available), (cost, True), str(cost))

    def test_done_is_recorded_and_the_lease_kept_until_it_is_known(self) -> None:
        """The finished agent stops, records the outcome once, and gives the lease back when the outcome is known."""
        self.dog.steps = 1
        self.acting()
        deed = self.step()
        self.assertEqual((deed.action, deed.permit.token), (STAND, 5))
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual([(r.outcome, r.by, r.token) for r in self.results], [(COMPLETED, "dog1", 5)])
        self.assertEqual(self.results[0].bids, (("dog1", 1.0), ("dog2", 2.0)))
        self.assertEqual(self.events, ["halted"])
        self.end(COMPLETED, "dog1")
        self.engagement.abandon(self.clock.seconds())
        self.assertEqual(self.events[-1], "released")

    def test_task_changes_hands_at_safe_points_only(self) -> None:
        """A better report waits until the body may be stopped; a lost body, a cancellation and a pause do not."""
        self.acting()
        self.dog.is_safe = False
        self.hear(self.report(2, 0.5))
        self.assertEqual(self.step().action, GO)
        self.dog.is_safe = True
        self.assertEqual(self.step().action, HOLD)
        self.assertEqual(self.events, ["halted", "released"])

    def test_pause_and_resume(self) -> None:
        """A paused task stops the body, gives the lease back and reports no body; resumed it goes on where it was."""
        self.acting()
        self.engagement.ordered(Order(PAUSE, "vaio", 1.0))
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual(self.events, ["halted", "released"])
        self.assertEqual((self.engagement.me.cost, self.engagement.me.available), (None, False))
        self.see(0.9)
        self.assertIsNone(self.engagement.me.cost)
        self.engagement.ordered(Order(RESUME, "vaio", 2.0))
        self.see(0.9)
        self.hear(self.report(2, 2.0))
        self.step()
        self.council.grant(6)
        self.assertEqual(self.step().action, GO)
        self.assertEqual(self.said[-3:], ["resumed by vaio", "reports 0.90 m", "acts: dog1, 0.90, best of 2"])

    def test_lease_is_kept_while_the_outcome_is_on_its_way(self) -> None:
        """A pause or another task that comes between the deed and its record does not give the lease to another."""
        self.dog.steps = 1
        self.acting()
        self.step()
        self.assertFalse(self.engagement.may_be_put_aside)
        self.engagement.put_aside("busy with T", self.clock.seconds())
        self.assertEqual(self.events, ["halted"])
        self.end(COMPLETED, "dog1")
        self.engagement.abandon(self.clock.seconds())
        self.assertEqual(self.events, ["halted", "released"])

    def test_deadline_fails_the_task_once(self) -> None:
        """Past its deadline the task fails by whoever acts, or by the first of those present, and by nobody else."""
        self.begin(replace(TASK, deadline=5.0))
        self.acting()
        self.clock.advance(5.1)
        self.council.grant(5)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual([(r.outcome, r.why) for r in self.results], [(FAILED, "past its deadline of 5 s")])

    def test_deadline_falls_to_one(self) -> None:
        """Who does not act leaves it to whoever does, or to the participant with the lowest uuid."""
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
        """Who is to end a task that nobody acts on claims it first: its council lets no other end it."""
        self.begin(replace(TASK, deadline=5.0))
        self.patch(self.engagement._conference, "is_first", lambda now: True)
        self.acting()
        self.clock.advance(5.1)
        for _ in range(2):
            self.assertIsNone(self.engagement.step(self.clock.seconds()))
            self.assertEqual((self.results, self.council.is_wanted), ([], True))
        self.council.grant(6)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertEqual([result.token for result in self.results], [6])

    def test_higher_token_reopens_the_task(self) -> None:
        """An agent that learns at the end that another was granted a higher token takes part again."""
        self.dog.steps = 1
        self.acting()
        self.step()
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.engagement.on(Event.REOPENED, self.clock.seconds())
        self.assertEqual(self.events[-1], "released")
        self.assertIsNotNone(self.engagement.step(self.clock.seconds()))

    def test_no_progress_gives_the_task_to_another(self) -> None:
        """Who comes no further within the stall limit gives the lease back and does not bid for as long."""
        self.begin(replace(TASK, stall_limit=1.0))
        self.dog.progress = 0.5
        self.acting()
        for _ in range(22):
            self.clock.advance(0.05)
            self.council.grant(5)
            self.step()
        self.assertEqual(self.events[:2], ["halted", "released"])
        self.assertIn("makes no progress", self.said)
        self.see(0.5)
        self.assertIsNone(self.engagement.me.cost)
        self.clock.advance(1.2)
        self.see(0.5)
        self.assertEqual(self.engagement.me.cost, 0.5)

    def test_behaviour_that_bids_nonsense_bids_nothing(self) -> None:
        """NaN, infinite, negative and enormous costs are never reported, whatever the behaviour says."""
        for cost in (float("nan"), float("inf"), -1.0, 1e300):
            self.see(cost)
            self.assertIsNone(self.engagement.me.cost)

    def test_validity_is_renewed(self) -> None:
        """A bid that counts for a while only is told again before it is void, with a new serial number."""
        self.dog.valid_for = 2.0
        self.see(1.0)
        self.clock.advance(1.1)
        self.see(1.0)
        self.assertEqual([(m.cost, m.serial, m.valid_for) for m in self.told], [(1.0, 1, 2.0), (1.0, 2, 2.0)])

    def test_failing_strategy_falls_back_to_nearest(self) -> None:
        """A strategy that raises is said once, and the nearest is assigned."""

        class Broken(Nearest):
            name = "broken"

            def find(self, contacts: Sequence[Report]) -> Consensus:
                """Fail."""
                raise ZeroDivisionError("no luck")

        self.begin(TASK, Guard(Broken()))
        self.hear(self.report(2, 0.5))
        self.see(1.0)
        self.step()
        self.step()
        faults = [line for line in self.said if "broken" in line and not line.startswith("standby")]
        self.assertEqual(faults, ["broken has no opinion (ZeroDivisionError: no luck); nearest: 0.50, least of 2"])
        self.assertEqual(self.engagement.me.assigned, self.others[2].node_id.hex())
        self.assertEqual(len(self.flushLoggedErrors(ZeroDivisionError)), 1)

    def test_outcome_absorbs_what_follows(self) -> None:
        """After the end nothing begins again; of two outcomes the one that holds everywhere is kept."""
        self.end(CANCELLED, "vaio")
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.assertIsNone(self.engagement.step(self.clock.seconds()))
        self.assertTrue(self.engagement.is_over)
        self.engagement.heard([], Result(COMPLETED, "dog2", 1.0, 9), self.clock.seconds())
        self.assertEqual(self.engagement.result, Result(COMPLETED, "dog2", 1.0, 9))
        self.engagement.heard([], Result(CANCELLED, "vaio"), self.clock.seconds())
        self.assertEqual(self.engagement.result, Result(COMPLETED, "dog2", 1.0, 9))

    def test_older_life_is_counted_on(self) -> None:
        """After a restart the agent counts its reports on from where the others know it, so that they are heard."""
        self.hear(Member(ME.node_id.hex(), "dog1", WAITING, 9.0, epoch=4, serial=3))
        self.see(1.0)
        self.assertGreater((self.told[-1].epoch, self.told[-1].serial), (4, 3))

    def test_heirs_hear_of_a_leave_from_the_one_that_leaves(self) -> None:
        """Who leaves the task names those that stand by, the next one first, and never itself."""
        contacts = {n: Contact(each.public, Address("10.0.0.1", n)) for n, each in self.others.items()}
        self.ports.known = {contact.node_id.hex(): contact for contact in contacts.values()}
        self.hear(self.report(2, 3.0), self.report(3, 2.0))
        self.see(1.0)
        self.step()
        self.council.grant(1)
        self.step()
        self.engagement.abandon(self.clock.seconds())
        self.assertEqual(self.council.heirs, [contacts[3], contacts[2]])

    def test_each_decision_is_accounted_for_once(self) -> None:
        """A new decision is told why at once, moved reports at most once a second, and an unchanged one never again."""
        accounts = self.ports.accounts
        self.step()
        self.assertEqual(accounts, [])
        self.hear(self.report(2, 2.0))
        self.see(1.0)
        self.step()
        self.assertEqual([(v.winner, v.epoch, v.token) for v in accounts], [(ME.node_id.hex(), 1, 0)])
        self.assertEqual([(r.name, r.cost) for r in accounts[0].reports], [("dog1", 1.0), ("dog2", 2.0)])
        for cost in (2.1, 2.2, 2.3, 2.4):
            self.hear(self.report(2, cost))
            self.clock.advance(0.1)
            self.step()
        self.assertEqual(len(accounts), 1)
        self.clock.advance(1.0)
        self.step()
        self.assertEqual(accounts[1].reports[1].cost, 2.4)
        self.clock.advance(5.0)
        self.step()
        self.assertEqual(len(accounts), 2)
