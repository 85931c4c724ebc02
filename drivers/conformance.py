"""Conformance: what every driver must hold to, as tests that anyone can run on one's own robot.

::

    class RoverTests(Conformance, SynchronousTestCase):
        bench = partial(MemoryBench, Rover, Emulator, {"host": "rover"})

or, without a test case, ``broken(partial(MemoryBench, ...))``, which gives a line for each rule that is broken.  Who
has a bench of another kind gives ``bench`` a function that makes that, or is the bench oneself: a test case with the
methods of ``Bench``.

What only senses (a description without limits) is held to the same rules but those of motion.
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
COUNTS = ("frames", "bad_frames", "bytes", "reconnects", "age", "accepted", "lower token", "late")
"""What ``diagnostics`` tells at least."""
AT_REST = 0.01
"""A robot that is slower, in m/s or rad/s, stands still."""
HALT_S = 0.2
"""After a stop, or its deadline, a robot has so long to stand still."""
NO_NUMBERS = (math.nan, math.inf, -math.inf, True, None, "0.1")


class Bench(Protocol):
    """A robot, or its stand-in, on a bench: what the rules need beside the driver.

    ``settle_s`` is how long it may take to connect, to switch the motors, or to close.
    """

    settle_s: float

    def make_driver(self) -> Driver:
        """A fresh driver of the robot that is not connected."""

    def pass_time(self, seconds: float) -> None:
        """Let time pass for driver and robot."""

    def now(self) -> float:
        """The driver's clock, in seconds."""

    def true_speed(self) -> float:
        """How fast the robot really moves, in m/s; asked of those that move."""

    def cut_link(self) -> None:
        """Break the link as a lost network does; it can be opened again.  ``NotImplementedError``: there is none."""


class StandIn(Protocol):
    """An emulated robot as ``MemoryBench`` needs it; it is made with the clock by which it lives."""

    def accept(self, link: Link) -> Receiver:
        """Serve a new link; returns who shall hear what arrives on it."""

    def true_speed(self) -> float:
        """How fast it moves now, in m/s."""


class MemoryBench:
    """A driver and an emulated robot, joined through memory, each by a clock that is turned by hand.

    ``make`` is what makes the driver, as ``drivers.registry`` calls it: (options, name, clock, connector).
    """

    settle_s = 0.3
    STEP_S = 0.005

    def __init__(
        self,
        make: Callable[[Mapping[str, object], str, Any, Any], Driver],
        robot: Callable[[Any], StandIn],
        options: Mapping[str, object],
    ) -> None:
        self._make = make
        self._options = options
        self._clock, self._robots_clock = Clock(), Clock()
        self.robot = robot(self._robots_clock)
        self.connector = MemoryConnector(self._robots_clock, self.robot.accept)

    def make_driver(self) -> Driver:
        """A fresh driver of the robot."""
        return self._make(self._options, "robot", self._clock, self.connector)

    def pass_time(self, seconds: float) -> None:
        """Turn both clocks, in small steps so that answers to answers arrive."""
        for _ in range(round(seconds / self.STEP_S)):
            self._robots_clock.advance(self.STEP_S)
            self._clock.advance(self.STEP_S)

    def now(self) -> float:
        """The driver's clock."""
        return self._clock.seconds()

    def true_speed(self) -> float:
        """What the robot does."""
        return self.robot.true_speed()

    def cut_link(self) -> None:
        """Break the link."""
        self.connector.cut()

    def left_over(self) -> int:
        """How many calls the driver has left on its clock."""
        return len(self._clock.getDelayedCalls())


class Breach(AssertionError):
    """A driver breaks a rule; the text says how."""


class Faulty(Exception):
    """What a subscriber raises on purpose."""


def check_describes(bench: Bench) -> None:
    """It says what its robot is and can do before it connects, and that stays so."""
    driver = bench.make_driver()
    body = driver.description
    _demand(driver.state == "idle", f"before connect its state is {driver.state!r}, not 'idle'")
    _demand(driver.observe() is None, "it observes something before it is connected")
    _demand(isinstance(body, Description) and bool(body.kind and body.model), "it does not say its kind and model")
    _demand(math.isfinite(body.radius) and body.radius > 0.0, f"its radius is {body.radius!r}")
    for key, (low, high) in body.limits.items():
        _demand(
            math.isfinite(low) and math.isfinite(high) and low < high and low <= 0.0 <= high,
            f"the limits of {key} are {low!r} and {high!r}; rest lies between them",
        )
    _demand(all(rate > 0.0 for rate in body.rates.values()), f"its rates are {dict(body.rates)!r}")
    _demand(all(isinstance(name, str) and name for name in body.skills), f"its skills are {body.skills!r}")
    try:
        json.dumps({name: dict(about) for name, about in body.capabilities.items()}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise Breach(f"its capabilities cannot be told to others: {error}") from error
    _connected(bench, driver)
    _demand(driver.description == body, "connected it describes itself otherwise")


def check_connects(bench: Bench) -> None:
    """The Deferred of ``connect`` fires when the first observation has arrived, and not before."""
    driver = bench.make_driver()
    has_seen: list[bool] = []

    def fired(told: Description) -> Description:
        has_seen.append(driver.observe() is not None)
        return told

    connected = _Answer(driver.connect().addCallback(fired))
    _demand(not connected.is_there, "connect fires within its own call")
    _demand(driver.state == "connecting", f"while it connects its state is {driver.state!r}")
    bench.pass_time(bench.settle_s)
    _demand(connected.value("connect") == driver.description, "connect does not fire with the description")
    _demand(has_seen == [True], "connect fires before there is something to observe")
    _demand(driver.state == "ready", f"connected its state is {driver.state!r}, not 'ready'")
    _demand(_Answer(driver.connect()).is_error(DriverError), "connected once, it can be connected again")


def check_motors(bench: Bench) -> None:
    """Nothing moves before ``enable`` and after ``disable``; ``enable`` lifts that."""
    driver = bench.make_driver()
    wish = _wish(driver)
    _refuses(NotEnabled, driver, wish, _permit(bench), "before it is connected")
    _connected(bench, driver)
    if wish:
        _refuses(NotEnabled, driver, wish, _permit(bench), "before enable")
        bench.pass_time(HALT_S)
        _demand_rest(bench, driver, "before enable")
    _enabled(bench, driver)
    driver.act(wish, _permit(bench, 30.0))
    bench.pass_time(bench.settle_s)
    disabled = _Answer(driver.disable())
    bench.pass_time(bench.settle_s)
    _demand(disabled.value("disable") is True, "disable does not fire with True")
    _demand(driver.state == "stopped", f"disabled its state is {driver.state!r}, not 'stopped'")
    _demand_rest(bench, driver, "after disable")
    _refuses(NotEnabled, driver, wish, _permit(bench), "after disable")
    _enabled(bench, driver)
    driver.act(wish, _permit(bench))


def check_clips(bench: Bench) -> None:
    """What ``act`` returns is what is really done: within the limits of the description."""
    driver = _ready(bench)
    for key, (low, high) in driver.description.limits.items():
        for wanted in (low - 99.0, high + 99.0):
            done = driver.act({**dict.fromkeys(driver.description.limits, 0.0), key: wanted}, _permit(bench))
            _demand(isinstance(done, Mapping) and key in done, f"act does not say what {key} became")
            for name, value in done.items():
                least, most = driver.description.limits.get(name, (-math.inf, math.inf))
                _demand(
                    isinstance(value, float | int) and least - 1e-9 <= value <= most + 1e-9,
                    f"asked for {key} = {wanted:g} it does {name} = {value!r}, beyond its limits",
                )
    axis = _axis(driver)
    if axis:
        high = driver.description.limits[axis][1]
        done = driver.act({**dict.fromkeys(driver.description.limits, 0.0), axis: high + 99.0}, _permit(bench))
        _demand(done[axis] > 0.5 * high, f"asked for more than it can, it does {axis} = {done[axis]:g}, not {high:g}")


def check_keeps(bench: Bench) -> None:
    """A key that an action does not name stays as it was while the last command holds, and is zero after a stop."""
    driver = _ready(bench)
    axis = _axis(driver)
    if not axis:
        return
    first = driver.act(_wish(driver), _permit(bench))[axis]
    _demand(driver.act({}, _permit(bench)).get(axis) == first, f"{axis} changes though the next action leaves it out")
    driver.stop()
    after = driver.act({}, _permit(bench)).get(axis)
    _demand(after == 0.0, f"after a stop an action that names nothing does {axis} = {after!r}")


def check_refuses(bench: Bench) -> None:
    """An unknown key, or a value that is no finite number, raises ``Unsupported``, and nothing moves."""
    driver = _ready(bench)
    _refuses(Unsupported, driver, {"base.warp": 1.0}, _permit(bench), "with an unknown key")
    for value in NO_NUMBERS if _axis(driver) else ():
        action: Any = {_axis(driver): value}
        _refuses(Unsupported, driver, action, _permit(bench), f"with {value!r}")
        _refuses(Unsupported, driver, {**_wish(driver), "base.warp": 1.0}, _permit(bench), "with a key too many")
    bench.pass_time(HALT_S)
    _demand_rest(bench, driver, "after what it refused")


def check_deadline(bench: Bench) -> None:
    """The robot moves while its permit holds, and stands still by itself soon after; a new permit moves that."""
    driver = _ready(bench)
    if not _axis(driver):
        return
    wanted = abs(driver.act(_wish(driver), _permit(bench, 0.6))[_axis(driver)])
    bench.pass_time(0.5)
    _demand(bench.true_speed() > 0.5 * wanted, f"it said that it does {wanted:g} and does {bench.true_speed():g}")
    driver.act(_wish(driver), _permit(bench, 0.6))
    bench.pass_time(0.5)
    _demand(bench.true_speed() > 0.5 * wanted, "it stops at the deadline of a command that was renewed")
    bench.pass_time(0.1 + HALT_S)
    _demand_rest(bench, driver, "after its deadline")


def check_token(bench: Bench) -> None:
    """A lower token than one seen, or a deadline that is not ahead, raises ``StaleCommand`` and is counted."""
    driver = _ready(bench)
    wish = _wish(driver)
    driver.act(wish, _permit(bench, token=5))
    _demand(driver.token == 5, f"having obeyed token 5 it tells {driver.token!r}")
    _refuses(StaleCommand, driver, wish, _permit(bench, token=4), "with a lower token")
    for deadline in (bench.now(), bench.now() - 1.0, math.nan, math.inf):
        _refuses(StaleCommand, driver, wish, Permit(6, deadline), f"with the deadline {deadline!r}, at {bench.now()!r}")
    driver.act(wish, _permit(bench, token=5))
    driver.stop()
    _refuses(StaleCommand, driver, wish, _permit(bench, token=4), "with a lower token, after a stop")
    counts = driver.diagnostics()
    _demand((counts["accepted"], counts["lower token"], counts["late"]) == (2, 2, 4), "it miscounts what it refused")


def check_stops(bench: Bench) -> None:
    """``stop`` is never refused, whatever the state, and brings the motion to rest."""
    driver = bench.make_driver()
    driver.stop()
    connecting = _Answer(driver.connect())
    driver.stop()
    bench.pass_time(bench.settle_s)
    connecting.value("connect, after stop,")
    _enabled(bench, driver)
    driver.act(_wish(driver), _permit(bench, 30.0))
    bench.pass_time(0.3)
    done = driver.stop()
    _demand(set(done) == set(driver.description.limits), "stop does not say what became of every limit's key")
    _demand(not any(done.values()), f"stop says that {dict(done)!r} is done")
    bench.pass_time(HALT_S)
    _demand_rest(bench, driver, "after stop")
    _Answer(driver.disable())
    driver.stop()
    bench.pass_time(bench.settle_s)
    driver.stop()
    if _cut(bench, driver):
        driver.stop()
    _Answer(driver.disconnect())
    driver.stop()
    bench.pass_time(bench.settle_s)
    driver.stop()


def check_ends(bench: Bench) -> None:
    """``disconnect`` stops the motion first, may be called twice and in any state, and is for good."""
    idle = bench.make_driver()
    left = _Answer(idle.disconnect())
    bench.pass_time(bench.settle_s)
    left.value("disconnect before connect")
    _demand(idle.state == "closed", f"disconnected before connect its state is {idle.state!r}")
    early = bench.make_driver()
    connecting = _Answer(early.connect())
    _Answer(early.disconnect())
    bench.pass_time(bench.settle_s)
    _demand(connecting.is_error(DriverError), "disconnected while it connects, connect does not fail")
    driver = _ready(bench)
    driver.act(_wish(driver), _permit(bench, 30.0))
    bench.pass_time(0.3)
    first, second = _Answer(driver.disconnect()), _Answer(driver.disconnect())
    _demand(driver.state == "closed", f"disconnected its state is {driver.state!r}, not 'closed'")
    bench.pass_time(bench.settle_s)
    first.value("disconnect")
    second.value("disconnect, called twice,")
    _demand_rest(bench, driver, "after disconnect")
    _demand(_Answer(driver.connect()).is_error(DriverError), "disconnected, it can be connected again")
    _refuses(DriverError, driver, _wish(driver), _permit(bench), "after disconnect")


def check_leaves(bench: Bench) -> None:
    """After ``disconnect``, or a ``connect`` that was cancelled, it is closed, and has no calls left on its clock."""
    driver = _ready(bench)
    driver.act(_wish(driver), _permit(bench, 30.0))
    _Answer(driver.disconnect())
    bench.pass_time(bench.settle_s)
    _demand_nothing_left(bench, "")
    for seconds in (0.0, 0.01):
        driver, seen = bench.make_driver(), list[Observation]()
        connecting = driver.connect()
        _Answer(connecting)
        bench.pass_time(seconds)
        if driver.observe() is not None:
            _Answer(driver.disconnect())
            bench.pass_time(bench.settle_s)
            return
        driver.subscribe(seen.append)
        connecting.cancel()
        bench.pass_time(bench.settle_s)
        _demand(driver.state == "closed", f"its connect cancelled, its state is {driver.state!r}, not 'closed'")
        _demand(not seen, "its connect cancelled, it observes all the same")
        _demand_nothing_left(bench, "its connect cancelled, ")


def check_link(bench: Bench) -> None:
    """A lost link makes it stale and brings the motion to rest; it comes back by itself, at rest."""
    driver = _ready(bench)
    driver.act(_wish(driver), _permit(bench, 30.0))
    bench.pass_time(0.3)
    if not _cut(bench, driver):
        return
    _demand(driver.state == "stale", f"without its link its state is {driver.state!r}, not 'stale'")
    _refuses(NotEnabled, driver, _wish(driver), _permit(bench), "without its link")
    bench.pass_time(max(1.0, 2.0 * bench.settle_s))
    _demand(driver.state == "ready", f"with its link back its state is {driver.state!r}, not 'ready'")
    _demand_rest(bench, driver, "after a lost link")
    counts = driver.diagnostics()
    _demand(counts["reconnects"] == 1.0, f"it came back once and counts {counts['reconnects']:g} reconnects")
    driver.act(_wish(driver), _permit(bench))


def check_times(bench: Bench) -> None:
    """Observations come in the order of time, none from the future, and ``observe`` gives the newest."""
    driver = _ready(bench)
    seen: list[Observation] = []
    driver.subscribe(seen.append)
    bench.pass_time(2.0 * bench.settle_s)
    _demand(len(seen) > 1, f"in {2.0 * bench.settle_s:g} s it observes {len(seen)} times")
    for before, after in zip(seen, seen[1:], strict=False):
        _demand(before.t_host <= after.t_host, f"t_host goes back from {before.t_host} to {after.t_host}")
        _demand(before.t_robot <= after.t_robot, f"t_robot goes back from {before.t_robot} to {after.t_robot}")
    _demand(seen[-1].t_host <= bench.now(), f"it observes at {seen[-1].t_host} what is now {bench.now()}")
    _demand(seen[-1].t_host > bench.now() - bench.settle_s, "t_host is not a moment of the driver's clock")
    _demand(driver.observe() is seen[-1], "observe does not give the newest observation")
    for key, value in seen[-1].values.items():
        _demand(isinstance(value, bool | int | float | str), f"{key} is {value!r}")
        _demand(isinstance(value, str) or not math.isinf(value), f"{key} is infinite; NaN says that there is nothing")


def check_subscribers(bench: Bench) -> None:
    """Each subscriber is told until it leaves, whatever another one does."""
    driver = _ready(bench)
    seen: list[Observation] = []

    def faulty(_observation: Observation) -> None:
        raise Faulty("not the driver's")

    end_faulty = driver.subscribe(faulty)
    end = driver.subscribe(seen.append)
    bench.pass_time(bench.settle_s)
    _demand(bool(seen), "a subscriber is told nothing, where another one raises")
    end_faulty()
    end()
    end()
    count = len(seen)
    bench.pass_time(bench.settle_s)
    _demand(len(seen) == count, "a subscriber that has left is told more")


def check_counts(bench: Bench) -> None:
    """``diagnostics`` are numbers under the agreed names, valid in any state, and the age is that of the newest."""
    driver = bench.make_driver()
    _demand(driver.diagnostics().get("age") == math.inf, "before the first observation its age is not infinite")
    _connected(bench, driver)
    counts: Mapping[str, Any] = driver.diagnostics()
    missing = [name for name in COUNTS if name not in counts]
    _demand(not missing, f"diagnostics lack {', '.join(missing)}")
    for name, value in counts.items():
        _demand(isinstance(value, float | int), f"{name} is {value!r}, no number")
    _demand(counts["frames"] > 0, "it counts no frames")
    _demand(counts["bad_frames"] == 0, f"it counts {counts['bad_frames']} bad frames of a robot that sends none")
    newest = driver.observe()
    age = math.inf if newest is None else bench.now() - newest.t_host
    _demand(abs(counts["age"] - age) < 1e-6, f"the newest is {age:g} s old, and it tells {counts['age']:g}")
    _demand(driver.state in STATES, f"its state is {driver.state!r}")


def check_invoke(bench: Bench) -> None:
    """``invoke`` fails with ``Unsupported`` for a skill that there is not."""
    driver = _ready(bench)
    for name in ("no such skill", ""):
        answer = _Answer(driver.invoke(name))
        bench.pass_time(0.1)
        _demand(answer.is_error(Unsupported), f"invoke({name!r}) does not fail with Unsupported")


CHECKS: dict[str, Callable[[Bench], None]] = {
    name.removeprefix("check_"): check for name, check in list(globals().items()) if name.startswith("check_")
}
"""The rules: each ``check_NAME`` of this module, in order."""


class Conformance:
    """Tests to be mixed into a test case that says ``bench = ...``, or that is a ``Bench`` itself.

    It has a method ``test_NAME`` for each rule of ``CHECKS``.
    """

    bench: Any = None
    settle_s = 0.3

    def _bench(self) -> Bench:
        bench = type(self).bench
        return cast(Bench, self if bench is None else bench())


def _test_of(check: Callable[[Bench], None]) -> Callable[[Conformance], None]:
    def test(case: Conformance) -> None:
        check(case._bench())
        # Under trial what a driver logs of a faulty subscriber fails the test, unless it is expected.
        getattr(case, "flushLoggedErrors", lambda _: None)(Faulty)

    test.__doc__ = check.__doc__
    return test


for _name, _check in CHECKS.items():
    setattr(Conformance, f"test_{_name}", _test_of(_check))


def broken(bench: Callable[[], Bench]) -> dict[str, str]:
    """Which rules a driver breaks, and how; one that raises breaks the rule.  Each rule gets a bench of its own."""
    found = {}
    for name, check in CHECKS.items():
        try:
            check(bench())
        except Exception as error:  # the driver is foreign code
            found[name] = str(error) if isinstance(error, Breach) else f"{type(error).__name__}: {error}"
    return found


class _Answer:
    """What a Deferred has fired with so far; an error that nobody asks for is nobody's."""

    def __init__(self, deferred: Deferred[Any]) -> None:
        self._told: list[Any] = []
        _demand(isinstance(deferred, Deferred), f"{deferred!r} is no Deferred")
        deferred.addBoth(self._told.append)

    @property
    def is_there(self) -> bool:
        return bool(self._told)

    def value(self, what: str) -> Any:
        """The value; ``what`` names the call in the breach."""
        _demand(bool(self._told), f"{what} does not fire in time")
        if isinstance(self._told[0], Failure):
            raise Breach(f"{what} fails: {self._told[0].getErrorMessage()}")
        return self._told[0]

    def is_error(self, kind: type[Exception]) -> bool:
        return bool(self._told) and isinstance(self._told[0], Failure) and bool(self._told[0].check(kind))


def _connected(bench: Bench, driver: Driver) -> None:
    connected = _Answer(driver.connect())
    bench.pass_time(bench.settle_s)
    connected.value("connect")


def _enabled(bench: Bench, driver: Driver) -> None:
    enabled = _Answer(driver.enable())
    bench.pass_time(bench.settle_s)
    _demand(enabled.value("enable") is True, "enable does not fire with True")


def _ready(bench: Bench) -> Driver:
    driver = bench.make_driver()
    _connected(bench, driver)
    _enabled(bench, driver)
    return driver


def _permit(bench: Bench, seconds: float = 0.5, token: int = 1) -> Permit:
    return Permit(token, bench.now() + seconds)


def _axis(driver: Driver) -> str:
    """The key whose motion ``Bench.true_speed`` sees; empty for what does not move."""
    limits = driver.description.limits
    return "base.vx" if "base.vx" in limits else next(iter(limits), "")


def _wish(driver: Driver) -> Action:
    """A motion at half of what the robot can; nothing, for what does not move."""
    axis = _axis(driver)
    return {axis: driver.description.limits[axis][1] / 2.0} if axis else {}


def _cut(bench: Bench, driver: Driver) -> bool:
    try:
        bench.cut_link()
    except NotImplementedError:
        if driver.description.limits:
            raise
        return False
    return True


def _refuses(kind: type[Exception], driver: Driver, action: Action, permit: Permit, when: str) -> None:
    try:
        driver.act(action, permit)
    except kind:
        return
    except Exception as error:
        raise Breach(f"act {when} raises {type(error).__name__}, not {kind.__name__}") from error
    raise Breach(f"act {when} does not raise {kind.__name__}")


def _demand_rest(bench: Bench, driver: Driver, when: str) -> None:
    if driver.description.limits:
        speed = bench.true_speed()
        _demand(speed < AT_REST, f"{when} the robot moves at {speed:.3g}")


def _demand_nothing_left(bench: Bench, when: str) -> None:
    left_over = getattr(bench, "left_over", None)
    count = 0 if left_over is None else left_over()
    _demand(count == 0, f"{when}it leaves {count} calls on its clock")


def _demand(is_so: bool, otherwise: str) -> None:
    if not is_so:
        raise Breach(otherwise)
