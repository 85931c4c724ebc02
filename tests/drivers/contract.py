"""What every driver must do, and what one that moves must do besides; the tests of each driver mix one of them in."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from drivers.driver import Driver, Permit
from drivers.errors import DriverError, NotEnabled, StaleCommand, Unsupported
from drivers.reading import Observation

if TYPE_CHECKING:
    from twisted.trial.unittest import SynchronousTestCase as _Case
else:
    _Case = object

STATES = {"idle", "connecting", "ready", "stale", "stopped", "closed"}


class SensingContract(_Case):
    """Conformance tests of any driver; whoever mixes them in says how one is made and how time passes."""

    def make_driver(self) -> Driver:
        """A fresh driver that is not connected."""
        raise NotImplementedError

    def pass_time(self, seconds: float) -> None:
        """Let time pass for driver and robot."""
        raise NotImplementedError

    def now(self) -> float:
        """The driver's clock."""
        raise NotImplementedError

    def ready(self) -> Driver:
        """A driver that is connected and enabled."""
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(0.3)
        self.successResultOf(connected)
        enabled = driver.enable()
        self.pass_time(0.3)
        self.assertIs(self.successResultOf(enabled), True)
        return driver

    def permit(self, token: int = 1, seconds: float = 0.5) -> Permit:
        """A permit that holds for some seconds from now."""
        return Permit(token, self.now() + seconds)

    def test_describes_itself_before_connecting(self) -> None:
        """A driver says what its robot is and can do while it is still idle."""
        driver = self.make_driver()
        self.assertEqual(driver.state, "idle")
        self.assertIsNone(driver.observe())
        self.assertTrue(driver.description.kind)
        self.assertGreater(driver.description.radius, 0.0)
        for low, high in driver.description.limits.values():
            self.assertLess(low, high)

    def test_connects_with_the_first_observation(self) -> None:
        """The Deferred of connect fires with the description when there is something to observe, and not before."""
        driver = self.make_driver()
        connected = driver.connect()
        self.assertNoResult(connected)
        self.assertEqual(driver.state, "connecting")
        self.pass_time(0.3)
        self.assertEqual(self.successResultOf(connected), driver.description)
        self.assertEqual(driver.state, "ready")
        self.assertIsNotNone(driver.observe())

    def test_tells_subscribers_until_they_leave(self) -> None:
        """Subscribers get each observation, in order of time, whatever another subscriber does, until they leave."""
        driver = self.ready()
        seen: list[Observation] = []

        def faulty(_observation: Observation) -> None:
            raise ValueError("not mine")

        end_faulty = driver.subscribe(faulty)
        end = driver.subscribe(seen.append)
        self.pass_time(0.3)
        end_faulty()
        end()
        end()
        count = len(seen)
        self.assertGreater(count, 3)
        self.assertEqual(len(self.flushLoggedErrors(ValueError)), count)
        self.assertEqual(seen, sorted(seen, key=lambda one: (one.t_host, one.t_robot)))
        self.pass_time(0.3)
        self.assertEqual(len(seen), count)

    def test_counts(self) -> None:
        """Diagnostics are numbers, and say how old the newest observation is."""
        driver = self.ready()
        numbers = driver.diagnostics()
        self.assertGreater(numbers["frames"], 0)
        self.assertEqual(numbers["bad_frames"], 0)
        self.assertLess(numbers["age"], 0.2)
        self.assertIn(driver.state, STATES)

    def test_ends_for_good_and_twice(self) -> None:
        """Disconnect may be called twice and in any state; after it there is no way back."""
        idle = self.make_driver()
        self.successResultOf(idle.disconnect())
        self.assertEqual(idle.state, "closed")
        driver = self.ready()
        self.failureResultOf(driver.connect(), DriverError)
        self.successResultOf(driver.disconnect())
        self.successResultOf(driver.disconnect())
        self.assertEqual(driver.state, "closed")
        self.failureResultOf(driver.connect(), DriverError)


class DriverContract(SensingContract):
    """Conformance tests of a driver whose robot moves, and has ``base.vx``."""

    def true_speed(self) -> float:
        """How fast the robot really moves, in m/s."""
        raise NotImplementedError

    def cut_link(self) -> None:
        """Break the link as a lost network does; it can be opened again."""
        raise NotImplementedError

    def test_refuses_motion_before_it_is_enabled(self) -> None:
        """Motors are off after connect: motion raises NotEnabled, and the robot stays where it is."""
        driver = self.make_driver()
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        driver.connect()
        self.pass_time(0.3)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.pass_time(0.3)
        self.assertLess(self.true_speed(), 0.01)

    def test_clips_and_echoes_an_action(self) -> None:
        """What act returns is what is really done: clipped to the limits of the description."""
        driver = self.ready()
        low, high = driver.description.limits["base.vx"]
        self.assertEqual(driver.act({"base.vx": 99.0}, self.permit())["base.vx"], high)
        self.assertEqual(driver.act({"base.vx": -99.0}, self.permit())["base.vx"], low)

    def test_keeps_what_an_action_does_not_name(self) -> None:
        """A missing key means unchanged while the last command is still in force, and zero after a stop."""
        driver = self.ready()
        driver.act({"base.vx": 0.1, "base.wz": 0.2}, self.permit())
        self.assertEqual(driver.act({"base.wz": 0.1}, self.permit())["base.vx"], 0.1)
        driver.stop()
        self.assertEqual(driver.act({"base.wz": 0.1}, self.permit())["base.vx"], 0.0)

    def test_refuses_what_it_cannot_do(self) -> None:
        """An unknown key and a value that is no finite number raise Unsupported, and nothing moves."""
        driver = self.ready()
        for action in ({"base.warp": 1.0}, {"base.vx": math.nan}, {"base.vx": math.inf}):
            self.assertRaises(Unsupported, driver.act, action, self.permit())
        self.pass_time(0.2)
        self.assertLess(self.true_speed(), 0.01)

    def test_moves_until_the_deadline_and_no_longer(self) -> None:
        """The robot walks while its permit holds and stands still by itself soon after."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=0.6))
        self.pass_time(0.5)
        self.assertGreater(self.true_speed(), 0.05)
        self.pass_time(0.3)
        self.assertLess(self.true_speed(), 0.01)

    def test_refuses_an_old_token_and_a_passed_deadline(self) -> None:
        """A lower token than one already seen, or a deadline not in the future, raises StaleCommand."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(token=5))
        self.assertRaises(StaleCommand, driver.act, {"base.vx": -0.1}, self.permit(token=4))
        self.assertRaises(StaleCommand, driver.act, {"base.vx": 0.1}, Permit(6, self.now()))
        driver.act({"base.vx": 0.1}, self.permit(token=5))

    def test_stops_in_any_state(self) -> None:
        """Stop is never refused: idle, connecting, moving or closed."""
        driver = self.make_driver()
        driver.stop()
        driver.connect()
        driver.stop()
        self.pass_time(0.3)
        driver.enable()
        self.pass_time(0.3)
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(0.3)
        self.assertGreater(self.true_speed(), 0.05)
        self.assertEqual(driver.stop()["base.vx"], 0.0)
        self.pass_time(0.2)
        self.assertLess(self.true_speed(), 0.01)
        driver.disconnect()
        driver.stop()

    def test_disables_and_enables_again(self) -> None:
        """Disable stops the motion and blocks it; enable lifts that."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(0.3)
        disabled = driver.disable()
        self.pass_time(0.3)
        self.assertIs(self.successResultOf(disabled), True)
        self.assertEqual(driver.state, "stopped")
        self.assertLess(self.true_speed(), 0.01)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        driver.enable()
        self.pass_time(0.3)
        driver.act({"base.vx": 0.1}, self.permit())

    def test_disconnects_at_rest_and_twice(self) -> None:
        """Disconnect stops the motion first, closes, and may be called again."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(0.3)
        self.successResultOf(driver.disconnect())
        self.assertEqual(driver.state, "closed")
        self.pass_time(0.3)
        self.assertLess(self.true_speed(), 0.01)
        self.successResultOf(driver.disconnect())
        self.failureResultOf(driver.connect(), DriverError)

    def test_stops_when_the_link_is_lost_and_comes_back(self) -> None:
        """A lost link stops the robot and makes the driver stale; it opens the link again and is ready, at rest."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(0.3)
        self.cut_link()
        self.assertEqual(driver.state, "stale")
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.pass_time(1.0)
        self.assertEqual(driver.state, "ready")
        self.assertLess(self.true_speed(), 0.01)
        driver.act({"base.vx": 0.1}, self.permit())
        self.assertEqual(driver.diagnostics()["reconnects"], 1.0)
