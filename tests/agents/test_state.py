"""Tests of ``agents.state``: the transition table, and the invariants of each reachable state."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from itertools import product
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.engagement import Engagement, RobotCommand
from agents.state import ROWS, TABLE, Effect, Event, State, StateMachine, build_table
from drivers.reading import Observation
from middleware.consensus.bidding.reporters import Reporters
from middleware.consensus.strategies.nearest import Nearest
from middleware.directory.presence import EXECUTING, STATUSES, WAITING
from middleware.entangled.clock import HeapClock
from middleware.tasks.order import PAUSE, RESUME, Order
from middleware.tasks.task import COMPLETED, Member, Result, Task
from tests.agents.state_table import PAGE, write_states
from tests.agents.test_engagement import CONTACT, GO, Dog, LeaseClientStub, Recorder

S = State
ME, OTHER = "1" * 40, "2" * 40
DEADLINE = 100.0


class TableTests(SynchronousTestCase):
    def test_each_pair_has_one_row(self) -> None:
        """The table has exactly one row for each event in each state, and no unused row."""
        named = [(state, row.event) for row in ROWS for state in row.states]
        self.assertEqual((len(named), set(TABLE)), (len(set(named)), set(product(State, Event))))
        for row in ROWS:
            self.assertNotEqual(set(build_table(each for each in ROWS if each is not row)), set(TABLE))

    def test_only_a_grant_leads_to_execution(self) -> None:
        """Only the event GRANTED leads to EXECUTING, and the effect EXECUTE occurs in no other state."""
        entered = {event for (state, event), (target, _) in TABLE.items() if S.EXECUTING is target is not state}
        executed = {target for target, effects in TABLE.values() if Effect.EXECUTE in effects}
        self.assertEqual((entered, executed), ({Event.GRANTED}, {S.EXECUTING}))

    def test_execution_ends_with_a_stopped_body(self) -> None:
        """Each transition out of EXECUTING has STOP as its first effect; no other state has this effect."""
        for (state, event), (target, effects) in TABLE.items():
            is_acting = state is S.EXECUTING
            self.assertEqual(Effect.STOP in effects[:1], is_acting and bool(effects) and Effect.EXECUTE not in effects)
            self.assertNotIn(Effect.STOP, effects[1:])
            if is_acting and target is not state:
                self.assertIn(Effect.STOP, effects, event.name)

    def test_the_end_is_the_end(self) -> None:
        """No transition leaves DONE, its only effect is HAND_OVER, and OUTCOME leads to DONE from each state."""
        follow = {(target, effects) for (state, _), (target, effects) in TABLE.items() if state is S.DONE}
        self.assertEqual(follow, {(S.DONE, ()), (S.DONE, (Effect.HAND_OVER,))})
        self.assertEqual({TABLE[state, Event.OUTCOME][0] for state in State}, {S.DONE})

    def test_statuses_are_those_of_the_page(self) -> None:
        """Each state has a known status, and only the state EXECUTING has the status EXECUTING."""
        self.assertTrue({state.status for state in S} <= set(STATUSES))
        self.assertEqual([state for state in S if state.status == EXECUTING], [S.EXECUTING])

    def test_rank_is_shown(self) -> None:
        """The text of a waiting agent contains its rank, which does not change until the next event."""
        machine = StateMachine()
        machine.state = S.OBSERVING
        for event, rank, shown in (
            (Event.PASSED_OVER, 2, "WAITING(2)"),
            (Event.LENT, None, "WAITING(2)"),
            (Event.NAMED, 0, "CLAIMING"),
        ):
            machine.apply(event, rank)
            self.assertEqual(str(machine), shown)

    def test_page_has_the_table(self) -> None:
        """The documentation contains the state table in its generated form."""
        self.assertIn(write_states(), PAGE.read_text(encoding="utf-8"))


class Rig:
    """An agent in a task, with stubs of the robot, the lease client, the other agent and the clock.

    It checks invariants.
    """

    def __init__(self) -> None:
        self.clock = HeapClock()
        self.events: list[str] = []
        self.dog = Dog()
        self.outputs = Recorder(self.events)
        self.lease_client = LeaseClientStub(self.clock, self.events)
        self.client: Any = self.lease_client
        self.others: list[Member] = []
        self.is_moving = self.is_late = self.has_left = False
        task = Task("t1", "find-target", "Find it", waiting_period=DEADLINE, deadline=DEADLINE, preemptible=True)
        me = Member(ME, "dog1", "")
        self.engagement = Engagement(task, me, self.dog, Nearest(), self.outputs, Reporters(ME), 0, 0.0)

    @property
    def key(self) -> tuple[object, ...]:
        """Return the part of the state that determines the effect of an input."""
        one, client = self.engagement, self.lease_client
        held = (
            one.state_machine.state,
            one.lease_client is not None,
            client.lease is not None,
            self.has_left,
            self.is_moving,
        )
        if one.is_over or self.has_left:
            return held
        asked = client.is_wanted, client.places[-1:] > [0], one.task_lease.is_lent, one.is_paused, self.is_late
        moves = one.state_machine.state is S.EXECUTING and (self.dog.is_safe, bool(one.task_lease.next_members))
        return (*held, *asked, moves, one.me.cost, *(other.cost for other in self.others))

    def feed(self, name: str) -> list[str]:
        """Apply one input and run a step; return the invariants that were violated."""
        for past in (
            self.events,
            self.outputs.reports,
            self.outputs.log_lines,
            self.outputs.decision_records,
            self.dog.contexts,
        ):
            past.clear()
        was_over = self.engagement.is_over
        now = self.clock.seconds()
        INPUTS[name](self, self.engagement, now)
        command = None if self.has_left else self.engagement.step(now)
        faults = self.faults(command)
        if was_over and (command or self.events not in ([], ["released"]) or self.outputs.reports):
            faults.append("something follows the outcome")
        if was_over and self.engagement.state_machine.state is not S.DONE:
            faults.append("the outcome does not stay")
        return faults

    def faults(self, command: RobotCommand | None) -> list[str]:
        """Return the invariants that the events and the ``command`` of a step violate."""
        faults = []
        for event in self.events:
            if event == "halted":
                self.is_moving = False
            elif self.is_moving and (event == "released" or event.startswith("moved")):
                faults.append("the lease is given back while the robot moves")
        lease = self.lease_client.lease
        if command is not None and command.action == GO:
            self.is_moving = True
            if lease is None or (command.permit.token, command.permit.deadline) != (lease.token, lease.deadline):
                faults.append("the robot acts without a lease")
        elif self.is_moving and command is not None:
            faults.append("the robot is not stopped before it does something else")
        if self.is_moving and (lease is None or self.engagement.lease_client is None):
            faults.append("the robot moves on without a lease")
        return faults


def hear(rig: Rig, one: Engagement, now: float, *others: Member) -> None:
    """Deliver the reports of ``others``; if ``others`` is empty, the other agents have left."""
    rig.others = list(others)
    one.process_reports(rig.others, None, now)


def take(rig: Rig, one: Engagement, now: float) -> None:
    """The agent lets the task control its robot."""
    if one.lease_client is None and not rig.has_left:
        one.take_robot(rig.client, one.task_lease.token)


def lend(rig: Rig, one: Engagement, now: float) -> None:
    """Another task of the group gets control of the robot, unless the agent acts on this task."""
    if not one.is_acting and one.can_yield_robot:
        one.set_robot_lent(True, now)


def finish(rig: Rig, one: Engagement, now: float) -> None:
    """The behaviour completes its task, if the agent acts."""
    if one.state_machine.state is S.EXECUTING:
        rig.dog.steps = 0


def grant(rig: Rig, one: Engagement, now: float) -> None:
    """The quorum grants the lease if the agent wants it."""
    if one.lease_client is not None and (rig.lease_client.is_wanted or rig.lease_client.places[-1:] > [0]):
        rig.lease_client.grant(one.task_lease.token + 1)


def lose(rig: Rig, one: Engagement, now: float) -> None:
    """The lease expires, and the robot stops at its deadline."""
    rig.lease_client.token, rig.is_moving = 0, False


def leave(rig: Rig, one: Engagement, now: float) -> None:
    """The agent leaves the task."""
    rig.has_left = True
    one.leave(now)


def expire(rig: Rig, one: Engagement, now: float) -> None:
    """The deadline of the task passes; a held lease is renewed."""
    rig.is_late = True
    rig.lease_client.deadline += DEADLINE
    rig.clock.advance(DEADLINE + 1.0)


INPUTS: dict[str, Callable[[Rig, Engagement, float], object]] = {
    "turn": lambda rig, one, now: None,
    "near": lambda rig, one, now: one.look(Observation(0.0, 0.0, {"cost": 1.0}), now),
    "blind": lambda rig, one, now: one.look(Observation(0.0, 0.0, {"cost": "none"}), now),
    "better": lambda rig, one, now: hear(rig, one, now, Member(OTHER, "dog2", WAITING, 0.2)),
    "mute": lambda rig, one, now: hear(rig, one, now, Member(OTHER, "dog2", WAITING)),
    "gone": hear,
    "take": take,
    "grant": grant,
    "lose": lose,
    "outrank": lambda rig, one, now: one.apply_event(Event.OUTRANKED, now),
    "lend": lend,
    "return": lambda rig, one, now: one.set_robot_lent(False, now),
    "aside": lambda rig, one, now: one.yield_robot("busy", now),
    "pause": lambda rig, one, now: one.process_order(Order(PAUSE, "vaio", 1.0)),
    "resume": lambda rig, one, now: one.process_order(Order(RESUME, "vaio", 2.0)),
    "silent": lambda rig, one, now: one.on_robot_lost(),
    "unsafe": lambda rig, one, now: setattr(rig.dog, "is_safe", False),
    "safe": lambda rig, one, now: setattr(rig.dog, "is_safe", True),
    "finish": finish,
    "council": lambda rig, one, now: one.schedule_council_change([CONTACT] * 3),
    "reopen": lambda rig, one, now: one.apply_event(Event.REOPENED, now),
    "outcome": lambda rig, one, now: one.process_reports([], Result(COMPLETED, "dog2", 1.0, 9), now),
    "leave": leave,
    "expire": expire,
}


class ReachableTests(SynchronousTestCase):
    def test_invariants_hold_in_each_state_that_is_reached(self) -> None:
        """Every input in every reachable state preserves the invariants, such as no action without a lease."""
        first = Rig()
        shared = {id(each): each for each in (first.engagement.task, CONTACT)}
        known: dict[tuple[object, ...], tuple[str, ...]] = {first.key: ()}
        open_ = [first]
        while open_:
            rig = open_.pop(0)
            way = known[rig.key]
            for name in INPUTS:
                after = deepcopy(rig, dict(shared))
                self.assertEqual(after.feed(name), [], (*way, name))
                if after.key not in known:
                    known[after.key] = (*way, name)
                    open_.append(after)
        self.assertEqual({key[0] for key in known}, set(State))
        self.assertEqual({key[0] for key in known if key[4]}, {S.EXECUTING})  # in these states the robot moves
        self.assertGreater(len(known), 400)
