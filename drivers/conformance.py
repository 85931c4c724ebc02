"""Conformance tests for drivers, for use by any project.

::

    class RoverTests(Conformance, SynchronousTestCase):
        rig = partial(MemoryRig, Rover, Emulator, {"host": "rover"})

Outside of a test case, ``find_violations(partial(MemoryRig, ...))`` returns a line for each broken rule. For a
different kind of test rig set ``rig`` to a function that creates the rig, or implement ``Rig`` in the test case.

Devices that only sense (their description has no limits) are exempt from the rules of motion.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol, cast

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.python.failure import Failure

from drivers.driver import Driver, Permit
from drivers.errors import DriverError, NotEnabled, StaleCommand, Unsupported
from drivers.link import Link, MemoryConnector, Receiver
from drivers.reading import Action, Description, Observation

STATES = ("idle", "connecting", "ready", "stale", "stopped", "closed")
COUNTER_NAMES = ("frames", "bad_frames", "bytes", "reconnects", "age", "accepted", "lower token", "late")
"""Keys that ``diagnostics`` must contain."""
REST_SPEED_MPS = 0.01
"""A robot stands still if its speed is below this, in m/s or rad/s."""
HALT_S = 0.2
"""Seconds within which a robot must stand still after a stop or the deadline of its command."""
INVALID_NUMBERS = (math.nan, math.inf, -math.inf, True, None, "0.1")


class Rig(Protocol):
    """A test rig with a robot or its emulator.

    ``settle_s`` is the time in seconds that connecting, switching the motors, or closing may take.
    """

    settle_s: float

    def make_driver(self) -> Driver:
        """Return a new, unconnected driver of the robot."""

    def pass_time(self, seconds: float) -> None:
        """Let time pass for driver and robot."""

    def now(self) -> float:
        """Return the time on the driver's clock, in seconds."""

    def true_speed(self) -> float:
        """Return the real speed of the robot in m/s; called only for robots that move."""

    def cut_link(self) -> None:
        """Break the link, which the driver may reopen. Raises ``NotImplementedError`` if the rig has no link."""


class EmulatedRobot(Protocol):
    """An emulated robot for ``MemoryRig``; it is created with its clock."""

    def accept(self, link: Link) -> Receiver:
        """Serve a new link; return the receiver of its data."""

    def true_speed(self) -> float:
        """Return its current speed in m/s."""


class MemoryRig:
    """A driver and an emulated robot connected in memory, each with a clock in virtual time.

    ``make`` creates the driver; its arguments are (options, name, clock, connector).
    """

    settle_s = 0.3
    STEP_S = 0.005

    def __init__(
        self,
        make: Callable[[Mapping[str, object], str, Any, Any], Driver],
        robot: Callable[[Any], EmulatedRobot],
        options: Mapping[str, object],
    ) -> None:
        self._make = make
        self._options = options
        self._clock, self._robots_clock = Clock(), Clock()
        self.robot = robot(self._robots_clock)
        self.connector = MemoryConnector(self._robots_clock, self.robot.accept)

    def make_driver(self) -> Driver:
        """Return a new driver of the robot."""
        return self._make(self._options, "robot", self._clock, self.connector)

    def pass_time(self, seconds: float) -> None:
        """Advance both clocks in steps small enough for exchanges of several messages."""
        for _ in range(round(seconds / self.STEP_S)):
            self._robots_clock.advance(self.STEP_S)
            self._clock.advance(self.STEP_S)

    def now(self) -> float:
        """Return the time on the driver's clock."""
        return self._clock.seconds()

    def true_speed(self) -> float:
        """Return the speed of the emulated robot."""
        return self.robot.true_speed()

    def cut_link(self) -> None:
        """Break the link."""
        self.connector.cut()

    def left_over(self) -> int:
        """Return the number of calls pending on the driver's clock."""
        return len(self._clock.getDelayedCalls())


class RuleViolation(AssertionError):
    """A driver breaks a rule; the message gives the details."""


class SubscriberError(Exception):
    """Raised deliberately by a subscriber."""


def check_describes(rig: Rig) -> None:
    """The driver describes its robot before it connects, and the description does not change."""
    driver = rig.make_driver()
    robot = driver.description
    _require(driver.state == "idle", f"before connect its state is {driver.state!r}, not 'idle'")
    _require(driver.observe() is None, "it has an observation before it is connected")
    _require(isinstance(robot, Description) and bool(robot.kind and robot.model), "its kind or model is empty")
    _require(math.isfinite(robot.radius) and robot.radius > 0.0, f"its radius is {robot.radius!r}")
    for key, (low, high) in robot.limits.items():
        _require(
            math.isfinite(low) and math.isfinite(high) and low < high and low <= 0.0 <= high,
            f"the limits of {key} are {low!r} and {high!r}; they must be finite and include 0",
        )
    _require(all(rate > 0.0 for rate in robot.rates.values()), f"its rates are {dict(robot.rates)!r}")
    _require(all(isinstance(name, str) and name for name in robot.skills), f"its skills are {robot.skills!r}")
    try:
        json.dumps({name: dict(about) for name, about in robot.capabilities.items()}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise RuleViolation(f"its capabilities are not valid JSON: {error}") from error
    _connect(rig, driver)
    _require(driver.description == robot, "its description changes when it connects")


def check_connects(rig: Rig) -> None:
    """The Deferred of ``connect`` fires when the first observation has arrived, not earlier."""
    driver = rig.make_driver()
    has_seen: list[bool] = []

    def fired(description: Description) -> Description:
        has_seen.append(driver.observe() is not None)
        return description

    connected = _Result(driver.connect().addCallback(fired))
    _require(not connected.has_fired, "connect fires within its own call")
    _require(driver.state == "connecting", f"while it connects its state is {driver.state!r}")
    rig.pass_time(rig.settle_s)
    _require(connected.value("connect") == driver.description, "connect does not fire with the description")
    _require(has_seen == [True], "connect fires before the first observation")
    _require(driver.state == "ready", f"connected its state is {driver.state!r}, not 'ready'")
    _require(_Result(driver.connect()).is_error(DriverError), "a connected driver can be connected again")


def check_motors(rig: Rig) -> None:
    """Nothing moves before ``enable`` or after ``disable``; ``enable`` permits motion again."""
    driver = rig.make_driver()
    action = _make_half_speed_action(driver)
    _check_refused(NotEnabled, driver, action, _grant(rig), "before it is connected")
    _connect(rig, driver)
    if action:
        _check_refused(NotEnabled, driver, action, _grant(rig), "before enable")
        rig.pass_time(HALT_S)
        _require_rest(rig, driver, "before enable")
    _enable(rig, driver)
    driver.act(action, _grant(rig, 30.0))
    rig.pass_time(rig.settle_s)
    disabled = _Result(driver.disable())
    rig.pass_time(rig.settle_s)
    _require(disabled.value("disable") is True, "disable does not fire with True")
    _require(driver.state == "stopped", f"disabled its state is {driver.state!r}, not 'stopped'")
    _require_rest(rig, driver, "after disable")
    _check_refused(NotEnabled, driver, action, _grant(rig), "after disable")
    _enable(rig, driver)
    driver.act(action, _grant(rig))


def check_clips(rig: Rig) -> None:
    """``act`` returns the action that the robot actually performs, within the limits of the description."""
    driver = _make_ready_driver(rig)
    for key, (low, high) in driver.description.limits.items():
        for wanted in (low - 99.0, high + 99.0):
            done = driver.act({**dict.fromkeys(driver.description.limits, 0.0), key: wanted}, _grant(rig))
            _require(isinstance(done, Mapping) and key in done, f"the result of act lacks {key}")
            for name, value in done.items():
                least, most = driver.description.limits.get(name, (-math.inf, math.inf))
                _require(
                    isinstance(value, float | int) and least - 1e-9 <= value <= most + 1e-9,
                    f"commanded {key} = {wanted:g} it performs {name} = {value!r}, beyond its limits",
                )
    axis = _select_axis(driver)
    if axis:
        high = driver.description.limits[axis][1]
        done = driver.act({**dict.fromkeys(driver.description.limits, 0.0), axis: high + 99.0}, _grant(rig))
        _require(done[axis] > 0.5 * high, f"beyond its limit it performs {axis} = {done[axis]:g}, not {high:g}")


def check_keeps(rig: Rig) -> None:
    """A key that an action omits keeps its value while the last command is in force; the value is zero after a stop."""
    driver = _make_ready_driver(rig)
    axis = _select_axis(driver)
    if not axis:
        return
    first = driver.act(_make_half_speed_action(driver), _grant(rig))[axis]
    _require(driver.act({}, _grant(rig)).get(axis) == first, f"{axis} changes though the next action omits it")
    driver.stop()
    after = driver.act({}, _grant(rig)).get(axis)
    _require(after == 0.0, f"after a stop an empty action performs {axis} = {after!r}")


def check_refuses(rig: Rig) -> None:
    """An unknown key, or a value that is not a finite number, raises ``Unsupported``, and nothing moves."""
    driver = _make_ready_driver(rig)
    _check_refused(Unsupported, driver, {"base.warp": 1.0}, _grant(rig), "with an unknown key")
    for value in INVALID_NUMBERS if _select_axis(driver) else ():
        action: Any = {_select_axis(driver): value}
        _check_refused(Unsupported, driver, action, _grant(rig), f"with {value!r}")
        action = {**_make_half_speed_action(driver), "base.warp": 1.0}
        _check_refused(Unsupported, driver, action, _grant(rig), "with a key too many")
    rig.pass_time(HALT_S)
    _require_rest(rig, driver, "after a refused action")


def check_deadline(rig: Rig) -> None:
    """The robot moves until its permit expires, and then stops; a new permit extends the motion."""
    driver = _make_ready_driver(rig)
    if not _select_axis(driver):
        return
    wanted = abs(driver.act(_make_half_speed_action(driver), _grant(rig, 0.6))[_select_axis(driver)])
    rig.pass_time(0.5)
    _require(rig.true_speed() > 0.5 * wanted, f"it reports {wanted:g} m/s and moves at {rig.true_speed():g}")
    driver.act(_make_half_speed_action(driver), _grant(rig, 0.6))
    rig.pass_time(0.5)
    _require(rig.true_speed() > 0.5 * wanted, "it stops at the deadline of a command that was renewed")
    rig.pass_time(0.1 + HALT_S)
    _require_rest(rig, driver, "after its deadline")


def check_token(rig: Rig) -> None:
    """A token lower than the highest seen, or an expired deadline, raises ``StaleCommand`` and is counted."""
    driver = _make_ready_driver(rig)
    action = _make_half_speed_action(driver)
    driver.act(action, _grant(rig, token=5))
    _require(driver.token == 5, f"after it obeyed token 5 its token is {driver.token!r}")
    _check_refused(StaleCommand, driver, action, _grant(rig, token=4), "with a lower token")
    for deadline in (rig.now(), rig.now() - 1.0, math.nan, math.inf):
        when = f"with the deadline {deadline!r}, at {rig.now()!r}"
        _check_refused(StaleCommand, driver, action, Permit(6, deadline), when)
    driver.act(action, _grant(rig, token=5))
    driver.stop()
    _check_refused(StaleCommand, driver, action, _grant(rig, token=4), "with a lower token, after a stop")
    counts = driver.diagnostics()
    _require((counts["accepted"], counts["lower token"], counts["late"]) == (2, 2, 4), "it miscounts commands")


def check_stops(rig: Rig) -> None:
    """``stop`` is never refused, in any state, and ends the motion."""
    driver = rig.make_driver()
    driver.stop()
    connecting = _Result(driver.connect())
    driver.stop()
    rig.pass_time(rig.settle_s)
    connecting.value("connect, after stop,")
    _enable(rig, driver)
    driver.act(_make_half_speed_action(driver), _grant(rig, 30.0))
    rig.pass_time(0.3)
    done = driver.stop()
    _require(set(done) == set(driver.description.limits), "the result of stop lacks a key of the limits")
    _require(not any(done.values()), f"stop returns a motion that is not zero: {dict(done)!r}")
    rig.pass_time(HALT_S)
    _require_rest(rig, driver, "after stop")
    _Result(driver.disable())
    driver.stop()
    rig.pass_time(rig.settle_s)
    driver.stop()
    if _try_cut_link(rig, driver):
        driver.stop()
    _Result(driver.disconnect())
    driver.stop()
    rig.pass_time(rig.settle_s)
    driver.stop()


def check_ends(rig: Rig) -> None:
    """``disconnect`` first stops the motion, is final, and may be called in any state and more than once."""
    idle = rig.make_driver()
    left = _Result(idle.disconnect())
    rig.pass_time(rig.settle_s)
    left.value("disconnect before connect")
    _require(idle.state == "closed", f"disconnected before connect its state is {idle.state!r}")
    early = rig.make_driver()
    connecting = _Result(early.connect())
    _Result(early.disconnect())
    rig.pass_time(rig.settle_s)
    _require(connecting.is_error(DriverError), "disconnect during connect does not make connect fail")
    driver = _make_ready_driver(rig)
    driver.act(_make_half_speed_action(driver), _grant(rig, 30.0))
    rig.pass_time(0.3)
    first, second = _Result(driver.disconnect()), _Result(driver.disconnect())
    _require(driver.state == "closed", f"disconnected its state is {driver.state!r}, not 'closed'")
    rig.pass_time(rig.settle_s)
    first.value("disconnect")
    second.value("disconnect, called twice,")
    _require_rest(rig, driver, "after disconnect")
    _require(_Result(driver.connect()).is_error(DriverError), "after disconnect it can be connected again")
    _check_refused(DriverError, driver, _make_half_speed_action(driver), _grant(rig), "after disconnect")


def check_leaves(rig: Rig) -> None:
    """After ``disconnect`` or a cancelled ``connect`` the driver is closed and has no pending calls on its clock."""
    driver = _make_ready_driver(rig)
    driver.act(_make_half_speed_action(driver), _grant(rig, 30.0))
    _Result(driver.disconnect())
    rig.pass_time(rig.settle_s)
    _require_no_pending_calls(rig, "")
    for seconds in (0.0, 0.01):
        driver, seen = rig.make_driver(), list[Observation]()
        connecting = driver.connect()
        _Result(connecting)
        rig.pass_time(seconds)
        if driver.observe() is not None:
            _Result(driver.disconnect())
            rig.pass_time(rig.settle_s)
            return
        driver.subscribe(seen.append)
        connecting.cancel()
        rig.pass_time(rig.settle_s)
        _require(driver.state == "closed", f"after a cancelled connect its state is {driver.state!r}, not 'closed'")
        _require(not seen, "after a cancelled connect it still observes")
        _require_no_pending_calls(rig, "after a cancelled connect ")


def check_link(rig: Rig) -> None:
    """After the loss of its link the driver is stale and the motion ends; it reconnects by itself, with no motion."""
    driver = _make_ready_driver(rig)
    driver.act(_make_half_speed_action(driver), _grant(rig, 30.0))
    rig.pass_time(0.3)
    if not _try_cut_link(rig, driver):
        return
    _require(driver.state == "stale", f"without its link its state is {driver.state!r}, not 'stale'")
    _check_refused(NotEnabled, driver, _make_half_speed_action(driver), _grant(rig), "without its link")
    rig.pass_time(max(1.0, 2.0 * rig.settle_s))
    _require(driver.state == "ready", f"with its link back its state is {driver.state!r}, not 'ready'")
    _require_rest(rig, driver, "after a lost link")
    counts = driver.diagnostics()
    _require(counts["reconnects"] == 1.0, f"it reconnected once and counts {counts['reconnects']:g} reconnects")
    driver.act(_make_half_speed_action(driver), _grant(rig))


def check_times(rig: Rig) -> None:
    """Observations arrive in order of time and never from the future, and ``observe`` returns the newest one."""
    driver = _make_ready_driver(rig)
    seen: list[Observation] = []
    driver.subscribe(seen.append)
    rig.pass_time(2.0 * rig.settle_s)
    _require(len(seen) > 1, f"in {2.0 * rig.settle_s:g} s it observes {len(seen)} times")
    for before, after in zip(seen, seen[1:], strict=False):
        _require(before.t_host <= after.t_host, f"t_host goes back from {before.t_host} to {after.t_host}")
        _require(before.t_robot <= after.t_robot, f"t_robot goes back from {before.t_robot} to {after.t_robot}")
    _require(seen[-1].t_host <= rig.now(), f"t_host {seen[-1].t_host} is later than now, {rig.now()}")
    _require(seen[-1].t_host > rig.now() - rig.settle_s, "t_host is not a time on the driver's clock")
    _require(driver.observe() is seen[-1], "observe does not return the newest observation")
    for key, value in seen[-1].values.items():
        _require(isinstance(value, bool | int | float | str), f"{key} is {value!r}")
        _require(isinstance(value, str) or not math.isinf(value), f"{key} is infinite; use NaN for nothing in range")


def check_subscribers(rig: Rig) -> None:
    """Each subscriber is called until it unsubscribes, even if another subscriber raises."""
    driver = _make_ready_driver(rig)
    seen: list[Observation] = []

    def faulty(_observation: Observation) -> None:
        raise SubscriberError("raised by the conformance test")

    end_faulty = driver.subscribe(faulty)
    end = driver.subscribe(seen.append)
    rig.pass_time(rig.settle_s)
    _require(bool(seen), "a subscriber is not called if another subscriber raises")
    end_faulty()
    end()
    end()
    count = len(seen)
    rig.pass_time(rig.settle_s)
    _require(len(seen) == count, "a subscriber is called after it unsubscribed")


def check_counts(rig: Rig) -> None:
    """``diagnostics`` returns numbers under the required names in any state; ``age`` is correct."""
    driver = rig.make_driver()
    _require(driver.diagnostics().get("age") == math.inf, "before the first observation its age is not infinite")
    _connect(rig, driver)
    counts: Mapping[str, Any] = driver.diagnostics()
    missing = [name for name in COUNTER_NAMES if name not in counts]
    _require(not missing, f"diagnostics lack {', '.join(missing)}")
    for name, value in counts.items():
        _require(isinstance(value, float | int), f"{name} is {value!r}, not a number")
    _require(counts["frames"] > 0, "it counts no frames")
    _require(counts["bad_frames"] == 0, f"it counts {counts['bad_frames']} bad frames of a robot that sends none")
    newest = driver.observe()
    age = math.inf if newest is None else rig.now() - newest.t_host
    _require(abs(counts["age"] - age) < 1e-6, f"the newest is {age:g} s old, not {counts['age']:g} s as reported")
    _require(driver.state in STATES, f"its state is {driver.state!r}")


def check_invoke(rig: Rig) -> None:
    """``invoke`` fails with ``Unsupported`` for an unknown skill."""
    driver = _make_ready_driver(rig)
    for name in ("no such skill", ""):
        answer = _Result(driver.invoke(name))
        rig.pass_time(0.1)
        _require(answer.is_error(Unsupported), f"invoke({name!r}) does not fail with Unsupported")


CHECKS: dict[str, Callable[[Rig], None]] = {
    name.removeprefix("check_"): check for name, check in list(globals().items()) if name.startswith("check_")
}
"""The rules by name: every function ``check_NAME`` of this module, in order."""


class Conformance:
    """A mixin for test cases that set ``rig = ...`` or implement ``Rig`` themselves.

    It has a method ``test_NAME`` for each rule of ``CHECKS``.
    """

    rig: Any = None
    settle_s = 0.3

    def _make_rig(self) -> Rig:
        rig = type(self).rig
        return cast(Rig, self if rig is None else rig())


def _make_test(check: Callable[[Rig], None]) -> Callable[[Conformance], None]:
    def test(case: Conformance) -> None:
        check(case._make_rig())
        # Trial fails a test on logged errors, and the driver logs the error of the faulty subscriber.
        getattr(case, "flushLoggedErrors", lambda _: None)(SubscriberError)

    test.__doc__ = check.__doc__
    return test


for _name, _check in CHECKS.items():
    setattr(Conformance, f"test_{_name}", _make_test(_check))


def find_violations(rig: Callable[[], Rig]) -> dict[str, str]:
    """Return each broken rule with its message; an exception also breaks a rule. Each check gets a new ``rig``."""
    found = {}
    for name, check in CHECKS.items():
        try:
            check(rig())
        except Exception as error:  # the driver is third-party code
            found[name] = str(error) if isinstance(error, RuleViolation) else f"{type(error).__name__}: {error}"
    return found


class _Result:
    """The result of a Deferred, if it has fired; an error is handled here, so Twisted does not log it as unhandled."""

    def __init__(self, deferred: Deferred[Any]) -> None:
        self._results: list[Any] = []
        _require(isinstance(deferred, Deferred), f"{deferred!r} is not a Deferred")
        deferred.addBoth(self._results.append)

    @property
    def has_fired(self) -> bool:
        return bool(self._results)

    def value(self, what: str) -> Any:
        _require(bool(self._results), f"{what} does not fire in time")
        if isinstance(self._results[0], Failure):
            raise RuleViolation(f"{what} fails: {self._results[0].getErrorMessage()}")
        return self._results[0]

    def is_error(self, kind: type[Exception]) -> bool:
        return bool(self._results) and isinstance(self._results[0], Failure) and bool(self._results[0].check(kind))


def _connect(rig: Rig, driver: Driver) -> None:
    connected = _Result(driver.connect())
    rig.pass_time(rig.settle_s)
    connected.value("connect")


def _enable(rig: Rig, driver: Driver) -> None:
    enabled = _Result(driver.enable())
    rig.pass_time(rig.settle_s)
    _require(enabled.value("enable") is True, "enable does not fire with True")


def _make_ready_driver(rig: Rig) -> Driver:
    driver = rig.make_driver()
    _connect(rig, driver)
    _enable(rig, driver)
    return driver


def _grant(rig: Rig, seconds: float = 0.5, token: int = 1) -> Permit:
    return Permit(token, rig.now() + seconds)


def _select_axis(driver: Driver) -> str:
    """Return the key of the motion that ``Rig.true_speed`` measures; empty if the device does not move."""
    limits = driver.description.limits
    return "base.vx" if "base.vx" in limits else next(iter(limits), "")


def _make_half_speed_action(driver: Driver) -> Action:
    """Return a motion at half of the limit; empty if the device does not move."""
    axis = _select_axis(driver)
    return {axis: driver.description.limits[axis][1] / 2.0} if axis else {}


def _try_cut_link(rig: Rig, driver: Driver) -> bool:
    try:
        rig.cut_link()
    except NotImplementedError:
        if driver.description.limits:
            raise
        return False
    return True


def _check_refused(kind: type[Exception], driver: Driver, action: Action, permit: Permit, when: str) -> None:
    try:
        driver.act(action, permit)
    except kind:
        return
    except Exception as error:
        raise RuleViolation(f"act {when} raises {type(error).__name__}, not {kind.__name__}") from error
    raise RuleViolation(f"act {when} does not raise {kind.__name__}")


def _require_rest(rig: Rig, driver: Driver, when: str) -> None:
    if driver.description.limits:
        speed = rig.true_speed()
        _require(speed < REST_SPEED_MPS, f"{when} the robot moves at {speed:.3g}")


def _require_no_pending_calls(rig: Rig, when: str) -> None:
    left_over = getattr(rig, "left_over", None)
    count = 0 if left_over is None else left_over()
    _require(count == 0, f"{when}it leaves {count} pending calls on its clock")


def _require(is_so: bool, otherwise: str) -> None:
    if not is_so:
        raise RuleViolation(otherwise)
