"""Tests of the conformance tests: each rule detects a driver that violates it."""

from __future__ import annotations

import math
import re
import runpy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.trial.unittest import SynchronousTestCase

from drivers.conformance import CHECKS, MemoryRig, SubscriberError, find_violations
from drivers.driver import Driver, Permit
from drivers.errors import LinkLost, NotEnabled
from drivers.reading import Action, Description, Observation, Value
from drivers.subscribers import Subscribers

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "driver"
EXAMPLE: Any = runpy.run_path(str(FOLDER / "robot.py"))
ROVER: Description = EXAMPLE["ROVER"]
EMULATOR: Any = runpy.run_path(str(FOLDER / "emulator.py"))["Emulator"]

if TYPE_CHECKING:
    from drivers.base import BaseDriver

    class Rover(BaseDriver):
        """A correct robot with the attributes that the type checker needs; the subclasses violate one rule each."""

        _line: Any
        _newest: Any

        def link_up(self, link: Any) -> None: ...
        def link_down(self) -> None: ...
else:
    Rover = EXAMPLE["Rover"]


class Shy(Rover):
    """Changes its description when it is connected."""

    @property
    def description(self) -> Description:
        return replace(ROVER, skills=() if self._newest is None else ("late",))


class Boundless(Rover):
    """Has an infinite limit."""

    @property
    def description(self) -> Description:
        return replace(ROVER, limits={"base.vx": (-math.inf, 0.3), "base.wz": (-2.0, 2.0)})


class Hasty(Rover):
    """Reports that it is connected as soon as its link is open."""

    def link_up(self, link: Any) -> None:
        super().link_up(link)
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.callback(self.description)


class Eager(Rover):
    """Moves while its motors are disabled."""

    def act(self, action: Action, permit: Permit) -> Action:
        try:
            return dict(super().act(action, permit))
        except NotEnabled:
            return dict(action)


class Restless(Rover):
    """Continues to move when it is disabled."""

    def disable(self) -> Deferred[bool]:
        self._wants_motors = False
        return succeed(True)


class Boastful(Rover):
    """Returns the requested action instead of the executed action."""

    def act(self, action: Action, permit: Permit) -> Action:
        super().act(action, permit)
        return {**self._motion, **action}


class Forgetful(Rover):
    """Sets missing values of an action to zero."""

    def act(self, action: Action, permit: Permit) -> Action:
        return dict(super().act({**dict.fromkeys(self.description.limits, 0.0), **action}, permit))


class Nostalgic(Rover):
    """Keeps its motion after a stop."""

    def _clear_motion(self) -> None:
        self._deadline_timer.cancel()
        self._gate.end_motion()

    def stop(self) -> Action:
        super().stop()
        return dict.fromkeys(self._motion, 0.0)


class Credulous(Rover):
    """Accepts invalid numbers and ignores unknown keys."""

    def act(self, action: Action, permit: Permit) -> Action:
        known = {key: value for key, value in action.items() if key in self._motion and value is not None}
        return dict(super().act({k: 0.0 if not _is_number(v) else v for k, v in known.items()}, permit))


class Endless(Rover):
    """Continues to move after its deadline."""

    def act(self, action: Action, permit: Permit) -> Action:
        done = dict(super().act(action, permit))
        self._deadline_timer.cancel()
        return done


class Abrupt(Rover):
    """Keeps the deadline of the first command, even if a later command extends it."""

    def act(self, action: Action, permit: Permit) -> Action:
        self._first = getattr(self, "_first", None) or permit.deadline
        return dict(super().act(action, Permit(permit.token, self._first)))


class Lawless(Rover):
    """Accepts commands with any token, even with an outdated one."""

    def act(self, action: Action, permit: Permit) -> Action:
        self._gate._token = None
        return dict(super().act(action, permit))


class Amnesic(Rover):
    """Forgets the highest token when it stops."""

    def stop(self) -> Action:
        self._gate._token = None
        return dict(super().stop())


class Stubborn(Rover):
    """Refuses to stop a robot at rest."""

    def stop(self) -> Action:
        if self.state != "ready":
            raise NotEnabled("it is not ready")
        return dict(super().stop())


class Deaf(Rover):
    """Reports a stop but continues to move."""

    def stop(self) -> Action:
        self._clear_motion()
        return dict(self._motion)


class Undying(Rover):
    """Connects again after it was disconnected."""

    def connect(self) -> Deferred[Description]:
        self._is_closed = self._is_open = False
        connected: Deferred[Description] = super().connect()
        return connected


class Clumsy(Rover):
    """Fails when it is disconnected twice."""

    def disconnect(self) -> Deferred[None]:
        if self._is_closed:
            return fail(LinkLost("it is closed"))
        gone: Deferred[None] = super().disconnect()
        return gone


class Haunting(Rover):
    """Leaves a delayed call."""

    def _open(self) -> None:
        super()._open()
        self._clock.callLater(60.0, print)


class Faithless(Rover):
    """Does not reconnect after a lost link."""

    def link_down(self) -> None:
        super().link_down()
        self._line.disconnect()


class Rash(Rover):
    """Resumes its motion after a reconnect."""

    def link_up(self, link: Any) -> None:
        super().link_up(link)
        if self._wants_motors:
            link.send(b"V 0.1 0\n")


class Unmoved(Rover):
    """Still reports that it is ready after its link was lost."""

    def link_down(self) -> None:
        self._is_up = True
        self._newest = replace(self._newest, t_host=math.inf)


class Backward(Rover):
    """Reports a robot time that decreases."""

    def _observed(self, values: Mapping[str, Value], t_robot: float, *rest: Any) -> None:
        super()._observed(values, -t_robot, *rest)


class Prophetic(Rover):
    """Reports observations with a future time."""

    def _observed(self, values: Mapping[str, Value], t_robot: float, *rest: Any) -> None:
        super()._observed(values, t_robot, *rest)
        self._newest = replace(self._newest, t_host=self._newest.t_host + 0.1)


class Infinite(Rover):
    """Reports an infinite range when it should report NaN."""

    def _observed(self, values: Mapping[str, Value], t_robot: float, *rest: Any) -> None:
        super()._observed({**values, "range.front": math.inf}, t_robot, *rest)


class Clinging(Rover):
    """Keeps calling a subscriber that has unsubscribed."""

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        super().subscribe(seen)
        return lambda: None


class Frail(Subscribers[Observation]):
    """Drops all subscribers if one of them raises an exception."""

    def notify(self, newest: Observation) -> None:
        try:
            for each in self._callbacks:
                each(newest)
        except SubscriberError:
            self._callbacks = []


class Fragile(Rover):
    """A driver that uses the faulty list of subscribers of ``Frail``."""

    def __init__(self, *given: Any, **more: Any) -> None:
        super().__init__(*given, **more)
        self._subscribers = Frail(self._name, self.log)


class Silent(Rover):
    """Lacks the counter of refused commands, and has an unknown counter."""

    def diagnostics(self) -> dict[str, float]:
        return {"frames": 1.0, "age": super().diagnostics()["age"]}


class Ageless(Rover):
    """Reports that its observations have the age zero."""

    def diagnostics(self) -> dict[str, float]:
        return {**super().diagnostics(), "age": 0.0}


class Obliging(Rover):
    """Accepts unknown skills."""

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        return succeed({})


class Rude(Rover):
    """Raises an exception when it should return a Deferred that fails."""

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        raise KeyError(name)


class Abandoned(Rover):
    """Does not close its link when ``connect`` is cancelled."""

    def _on_cancelled_connecting(self, _connecting: object) -> None:
        self._mark_closed()


BREACHES: dict[str, list[Any]] = {
    "describes": [Shy, Boundless],
    "connects": [Hasty],
    "motors": [Eager, Restless],
    "clips": [Boastful],
    "keeps": [Forgetful, Nostalgic],
    "refuses": [Credulous],
    "deadline": [Endless, Abrupt],
    "token": [Lawless, Amnesic],
    "stops": [Stubborn, Deaf],
    "ends": [Undying, Clumsy],
    "leaves": [Haunting, Abandoned],
    "link": [Faithless, Rash, Unmoved],
    "times": [Backward, Prophetic, Infinite],
    "subscribers": [Clinging, Fragile],
    "counts": [Silent, Ageless],
    "invoke": [Obliging, Rude],
}


def bench(driver: Callable[..., Driver]) -> Callable[[], MemoryRig]:
    """Return a test rig with this driver and a correct robot."""
    return partial(MemoryRig, driver, EMULATOR, {"host": "rover"})


def _is_number(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _pairs() -> Iterator[tuple[str, Any]]:
    for rule, classes in BREACHES.items():
        yield from ((rule, each) for each in classes)


class KitTests(SynchronousTestCase):
    def tearDown(self) -> None:
        self.flushLoggedErrors(SubscriberError)

    def test_every_rule_sees_its_breach(self) -> None:
        """A driver that violates a rule fails the check for this rule."""
        self.assertEqual(set(BREACHES), set(CHECKS))
        found = {each.__name__: find_violations(bench(each)) for _, each in _pairs()}
        self.assertEqual([(rule, each.__name__) for rule, each in _pairs() if rule not in found[each.__name__]], [])

    def test_only_what_is_broken(self) -> None:
        """A driver that violates one rule passes the checks for all other rules."""
        for rule, driver in (("clips", Boastful), ("refuses", Credulous), ("leaves", Haunting), ("times", Backward)):
            self.assertEqual(list(find_violations(bench(driver))), [rule], driver.__name__)

    def test_template_conforms(self) -> None:
        """The example driver passes all checks, and has fewer than 50 lines of code."""
        self.assertEqual(find_violations(bench(Rover)), {})
        lines = (FOLDER / "robot.py").read_text(encoding="utf-8").splitlines()
        self.assertLess(len([line for line in lines if line.strip()]), 50)

    def test_document_names_every_rule(self) -> None:
        """The table of rules in the documentation lists the checks in the order in which they run."""
        text = (FOLDER.parents[1] / "docs" / "how-to" / "write-a-driver.md").read_text(encoding="utf-8")
        table = text.partition("| rule | ")[2].partition("\n\n")[0]
        self.assertEqual(re.findall(r"^\| (\w+) \|", table, re.MULTILINE), list(CHECKS))

    def test_tells_what_is_wrong(self) -> None:
        """The message of a violation states expected and actual behaviour.

        An exception is a violation with its name.
        """
        self.assertIn("after its deadline the robot moves at 0.15", find_violations(bench(Endless))["deadline"])
        self.assertIn("KeyError", find_violations(bench(Rude))["invoke"])
