"""Tests of ``drivers.compass`` against ``sim.robots.emulator.compass``, connected in memory."""

from __future__ import annotations

import math

from drivers.compass.driver import HEADING, SILENCE_S
from drivers.conformance import Conformance
from drivers.driver import Driver
from drivers.errors import LinkLost
from drivers.link import MemoryConnector
from sim.robots.dog import Dog
from sim.robots.emulator.compass import NmeaCompass
from sim.robots.scene import DogPlacement
from tests.drivers.contract import KeptLink, KeptLog, RobotCase


class CompassDriverTests(Conformance, RobotCase):
    """The compass driver passes the conformance tests for sensors and further tests of its functions."""

    kind = "compass"
    options = {"rate": 20, "host": "10.0.0.8"}

    def build(self) -> None:
        """Create a compass that points along the x axis."""
        self.body.values = {HEADING: 0.0}
        self.compass = self.robot = NmeaCompass(self.clock, self.body, 20.0)
        self.compass.start()
        self.compass.start()
        self.faults = self.compass.faults
        self.connector = MemoryConnector(self.clock, self.compass.accept)

    def heading(self, driver: Driver) -> float:
        """Return the newest heading in degrees."""
        return math.degrees(self.value(driver, HEADING))

    def test_turns_as_the_yard_does(self) -> None:
        """The driver reports the heading of a simulated dog, which is counted counter-clockwise from the x axis."""
        driver = self.make_driver()
        driver.connect()
        for degrees in (0.0, 45.0, 90.0, 179.9, -179.9, -90.0, -0.04):
            # The heading of a simulated dog is the value of its compass (sim.robots.sensor).
            dog = Dog(DogPlacement("dog1", 0.0, 0.0, math.radians(degrees), 1), 1)
            self.body.values[HEADING] = dog.heading
            self.pass_time(0.2)
            self.assertTrue(abs(math.remainder(self.heading(driver) - degrees, 360.0)) < 0.06, degrees)

    def test_counts_from_the_yards_axis(self) -> None:
        """Degrees clockwise from north become radians counter-clockwise from the x axis, which by default is east."""
        north = self.make_driver()
        turned = self.make_driver(mounted_deg=30)
        other = self.make_driver(x_axis_deg=0)
        for driver in (north, turned, other):
            driver.connect()
        self.body.values[HEADING] = math.radians(90.0)  # the compass reads 0: north
        self.pass_time(0.2)
        for driver, degrees in ((north, 90.0), (turned, 60.0), (other, 0.0)):
            self.assertAlmostEqual(self.heading(driver), degrees, 6)

    def test_allows_for_the_place(self) -> None:
        """Deviation and variation in a sentence are applied.

        If they are missing, the variation in the options is applied.
        """
        self.compass.deviation, self.compass.variation = 3.0, -12.0
        self.body.values[HEADING] = math.radians(20.0)
        for kinds, options in (
            (("HDG",), {"variation_deg": 50.0}),
            (("HDT",), {"variation_deg": 50.0}),
            (("HDM",), {"variation_deg": -12.0}),
        ):
            self.compass.kinds = kinds
            driver = self.make_driver(**options)
            driver.connect()
            self.pass_time(0.2)
            self.assertAlmostEqual(self.heading(driver), 20.0, 6)

    def test_believes_the_best_sentence(self) -> None:
        """If a compass sends several sentence types, the most accurate type is used.

        If sentences of this type stop, the next best type is used.
        """
        self.compass.variation = 10.0
        self.compass.kinds = ("HDM", "HDT")
        driver, seen = self.make_driver(), set[float]()
        driver.connect()
        self.pass_time(0.2)
        driver.subscribe(lambda one: seen.add(round(math.degrees(float(one.values[HEADING])))))
        self.pass_time(0.5)
        self.assertEqual(seen, {0})
        self.compass.kinds = ("HDM",)
        self.pass_time(1.0)
        self.assertEqual(driver.state, "stale")
        self.pass_time(3.0)
        self.assertEqual((driver.state, seen), ("ready", {0, 10}))

    def test_names_why_there_is_no_heading(self) -> None:
        """Refusal, silence, noise and unusable sentences each set ``problem`` and are logged once.

        A heading clears ``problem``.
        """
        self.connector.is_open = False
        driver = self.make_driver()
        driver.log = log = KeptLog()
        connected = driver.connect()
        self.pass_time(SILENCE_S + 0.1)
        self.assertEqual(
            driver.problem, "nothing answers at 10.0.0.8:10110; is the compass switched on, and in this network?"
        )
        self.connector.is_open, self.faults.half_open = True, True
        self.pass_time(60.0)
        self.assertIn("sends nothing", driver.problem)
        self.faults.half_open = False
        self.body.values.clear()
        self.pass_time(60.0)
        self.assertIn("no sentences", driver.problem)
        self.assertGreater(driver.diagnostics()["bad_frames"], 100)
        self.compass.kinds = ("VHW",)
        self.pass_time(60.0)
        self.assertIn("no heading", driver.problem)
        self.assertNoResult(connected)
        self.compass.kinds = ("HDT",)
        self.body.values[HEADING] = 0.0
        self.pass_time(1.0)
        self.successResultOf(connected)
        self.assertEqual((driver.problem, len(log.lines), len(set(log.lines))), ("", 4, 4))

    def test_hangs_up_on_silence(self) -> None:
        """A link without data is closed and opened again, because the other end may have failed."""
        driver = self.ready()
        silent = self.compass.clients[0]
        self.faults.half_open = True
        self.pass_time(SILENCE_S + 0.5)
        self.assertNotIn(silent, self.compass.clients)
        self.faults.half_open = False
        self.pass_time(1.0)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"]), ("ready", 1.0))

    def test_asks_for_the_baud_rate(self) -> None:
        """On a serial port, the problem with noise contains the baud rate; with a closed device, the device name."""
        self.compass.kinds = ()
        self.options = {"rate": 20, "device": "/dev/ttyUSB1", "baud": 9600}
        driver = self.make_driver()
        connected = driver.connect()
        self.connector.is_open = False
        self.pass_time(SILENCE_S + 0.1)
        self.assertEqual(driver.problem, "/dev/ttyUSB1 is not open")
        self.connector.is_open = True
        for _ in range(600):
            for client in self.compass.clients:
                client.output.send(b"\x00\xf8\x80\x0d")
            self.pass_time(0.1)
        self.assertEqual(driver.problem, "the device sends data, but no sentences; is 9600 baud right?")
        self.assertGreater(driver.diagnostics()["bad_frames"], 500)
        driver.disconnect()
        self.failureResultOf(connected, LinkLost)

    def test_drops_what_is_spoilt(self) -> None:
        """An invalid sentence never gives a heading, and the valid sentences in between are read."""
        driver, seen = self.make_driver(), set[float]()
        driver.connect()
        self.faults.garbage, self.faults.split, self.faults.drop = 0.3, True, 0.1
        self.pass_time(0.5)
        driver.subscribe(lambda one: seen.add(round(math.degrees(float(one.values[HEADING])), 3)))
        self.pass_time(60.0)
        self.assertEqual(seen, {0.0})
        counts = driver.diagnostics()
        self.assertTrue(counts["bad_frames"] > 200 and counts["frames"] > 600, counts)

    def test_serves_whoever_listens(self) -> None:
        """The emulated compass sends to all clients except clients with a full buffer, and ignores received data."""
        slow, quick = KeptLink(), KeptLink()
        one, _ = self.compass.accept(slow), self.compass.accept(quick)
        one.data_received(b"$PXYZ,1\r\n")
        slow.is_busy = True
        self.pass_time(1.0)
        self.assertEqual(slow.said, b"")
        self.assertGreater(quick.said.count(b"$HCHDG,90.0,0.0,E,0.0,E*"), 15)
        one.link_down()
        one.link_down()
        self.compass.stop()
        self.assertTrue(quick.is_closed)
