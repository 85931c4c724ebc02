"""Tests of ``drivers.aibo.driver`` against the emulated dog, joined through memory."""

from __future__ import annotations

import math
import random

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.aibo.codec import T2, T4, WorldState
from drivers.aibo.driver import AiboDriver
from drivers.driver import Driver
from drivers.errors import LinkLost, NotEnabled, Unsupported
from drivers.reading import Observation
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.body import MemoryBody
from swarmnode.driver.witness import Ear
from tests.drivers.contract import BodyContract
from tests.webnode.picture import jpeg

STEP_S = 0.004


class _Case(SynchronousTestCase):
    def near(self, value: float, wanted: float, off: float) -> None:
        """Whether a value is as wanted, but for so much."""
        self.assertLessEqual(abs(value - wanted), off)


class AiboDriverTests(BodyContract, _Case):
    """A dog of Tekkotsu 4 keeps the contract, and what is its own."""

    STEP_S = STEP_S

    dialect = T4

    def setUp(self) -> None:
        """A dog on a clock that is turned by hand."""
        self.clock = Clock()
        self.body = MemoryBody()
        self.dog = AiboEmulator(self.clock, self.body, random.Random(1), self.dialect)
        self.dog.start()
        self.connector = self.dog.connector()
        self.drivers: list[AiboDriver] = []

    def tearDown(self) -> None:
        """Nothing is left on the clock once all have gone."""
        for driver in self.drivers:
            driver.disconnect()
        self.pass_time(0.02)
        self.dog.stop()
        self.pass_time(0.02 + self.dog.faults.delay)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def make_driver(self, **options: object) -> AiboDriver:
        """A driver of the dog."""
        driver = AiboDriver({"host": "dog1", "camera": False, **options}, "dog1", self.connector, self.clock)
        self.drivers.append(driver)
        return driver

    def seen(self, driver: Driver) -> Observation:
        """The newest observation."""
        newest = driver.observe()
        assert newest is not None
        return newest

    def test_senses_what_an_ers7_has(self) -> None:
        """Ranges, accelerations, power, buttons, joints, the switch, the dialect and reckoned odometry are observed."""
        self.body.values = {"range.near": 0.25, "power.level": 0.5, "imu.ax": 1.0}
        driver = self.ready()
        values = self.seen(driver).values
        self.assertEqual((values["range.near"], values["power.level"], values["imu.ax"]), (0.25, 0.5, 1.0))
        self.assertTrue(math.isnan(float(values["range.far"])))
        self.assertAlmostEqual(float(values["imu.az"]), 9.81, places=5)
        self.assertIs(values["estop.engaged"], False)
        self.assertEqual(values["mode"], self.dialect)
        self.assertIn("joint.NECK:pan.pos", values)
        driver.act({"base.vx": 0.1, "base.wz": 0.5}, self.permit(seconds=2.0))
        self.pass_time(1.0)
        values = self.seen(driver).values
        self.near(float(values["odom.x"]), self.body.x, 0.01)
        self.near(float(values["odom.yaw"]), self.body.yaw, 0.05)

    def test_tells_31_frames_a_second(self) -> None:
        """The dog's 31.25 world states a second all arrive."""
        driver = self.ready()
        before = driver.diagnostics()["frames"]
        self.pass_time(2.0)
        self.near(driver.diagnostics()["frames"] - before, 62.5, 1.0)

    def test_says_a_live_walk_again_and_a_still_dog_nothing(self) -> None:
        """A walk longer than the dog's own 3 s goes on, as it is said again; a dog at rest is not spoken to."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(4.5)
        self.assertGreater(self.true_speed(), 0.05)
        self.pass_time(1.0)
        self.assertEqual(self.true_speed(), 0.0)
        self.dog.heard.clear()
        self.pass_time(2.0)
        self.assertEqual(self.dog.heard, [])

    def test_stops_by_the_dogs_own_timer(self) -> None:
        """A dog that hears no more, though its links stand, stands still 3 s after the last command."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=20.0))
        self.pass_time(0.1)
        self.dog.faults.half_open = True
        self.pass_time(2.5)
        self.assertGreater(self.true_speed(), 0.05)
        self.assertEqual(driver.state, "stale")
        self.pass_time(0.6)
        self.assertEqual(self.true_speed(), 0.0)

    def test_shares_the_stride_with_the_turn(self) -> None:
        """At full turn nothing is left for walking, and act says so."""
        driver = self.ready()
        done = driver.act({"base.vx": 0.16, "base.vy": -0.103, "base.wz": 2.03 / 2}, self.permit())
        self.assertAlmostEqual(done["base.vx"], 0.08)
        self.assertAlmostEqual(done["base.vy"], -0.0515)
        self.assertEqual(driver.act({"base.wz": 9.0}, self.permit())["base.vx"], 0.0)

    def test_recovers_from_silence(self) -> None:
        """Half a second without a world state makes it stale; when the dog speaks again it is ready, at rest."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=20.0))
        self.dog.faults.drop = 1.0
        self.pass_time(0.7)
        self.assertEqual(driver.state, "stale")
        self.assertEqual(self.true_speed(), 0.0)
        self.dog.faults.drop = 0.0
        self.pass_time(4.0)
        self.assertEqual(driver.state, "ready")
        self.assertEqual(self.true_speed(), 0.0)

    def test_names_rubbish_once(self) -> None:
        """A port that says rubbish for a minute is one line in the log, and another one after it spoke well between."""
        ear = Ear()
        self.addCleanup(ear.close)
        self.ready()
        for lines in (1, 2):
            self.patch(self.dog, "_send_state", self._say_rubbish)
            self.dog.stop()
            self.dog.start()
            self.pass_time(60.0)
            self.assertEqual(len([line for line in ear.heard if "is no world state" in line]), lines)
            del self.dog._send_state
            self.dog.stop()
            self.dog.start()
            self.pass_time(8.0)
            self.assertEqual(self.drivers[0].state, "ready")

    def _say_rubbish(self) -> None:
        client = self.dog.clients.get("state")
        if client is not None:
            client.link.send(random.randbytes(40))

    def test_recovers_from_a_reboot(self) -> None:
        """A dog that was switched off and on is asked for its servers again, and its motors as they were wanted."""
        driver = self.ready()
        self.dog.reboot()
        self.pass_time(0.01)
        self.assertEqual(driver.state, "stale")
        self.pass_time(3.0)
        self.assertEqual(driver.state, "ready")
        driver.act({"base.vx": 0.1}, self.permit())
        self.pass_time(0.1)
        self.assertGreater(self.true_speed(), 0.05)

    def test_recovers_from_a_reboot_that_nobody_told(self) -> None:
        """A dog that fell silent and comes back without its servers is asked for them again."""
        driver = self.ready()
        self.dog.faults.half_open = True
        self.pass_time(0.4)
        self.dog.menu.reset()
        for service in ("state", "walk", "head"):
            self.dog.clients[service].link.close()
        self.dog.faults.half_open = False
        self.pass_time(5.0)
        self.assertEqual(driver.state, "ready")

    def test_opens_each_needed_link_again(self) -> None:
        """Losing any one of the needed links stops the dog, and it is ready again soon."""
        for service in ("state", "estop", "walk"):
            driver = self.ready()
            driver.act({"base.vx": 0.1}, self.permit(seconds=20.0))
            self.pass_time(0.1)
            self.connector.cut(self.dog.ports[service])
            self.pass_time(0.01)
            self.assertEqual(driver.state, "stale", service)
            if service != "walk":
                self.assertEqual(self.true_speed(), 0.0, service)
            self.pass_time(1.5)
            self.assertEqual((driver.state, self.true_speed()), ("ready", 0.0), service)
            driver.disconnect()
            self.pass_time(0.1)

    def test_respects_the_switch_on_the_dog(self) -> None:
        """Who presses the dog's back stops it, and only enable lifts that, not a link that comes back."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=20.0))
        self.pass_time(0.1)
        self.dog.press()
        self.pass_time(0.1)
        self.assertEqual(self.true_speed(), 0.0)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.cut_link()
        self.pass_time(2.0)
        self.assertTrue(self.dog.is_engaged)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.dog.press()
        for _ in range(10):
            self.pass_time(STEP_S)
            self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.assertTrue(self.dog.is_engaged)
        enabled = driver.enable()
        self.pass_time(0.1)
        self.assertIs(self.successResultOf(enabled), True)

    def test_stops_motors_that_another_left_on(self) -> None:
        """A dog that somebody left with its motors on is stopped by connecting."""
        self.dog.press()
        driver = self.make_driver()
        driver.connect()
        self.pass_time(0.3)
        self.assertTrue(self.dog.is_engaged)

    def test_waits_for_a_port_that_another_client_holds(self) -> None:
        """One client a port: a second driver waits, counts what does not answer, and follows when the first left."""
        first = self.ready()
        second = self.make_driver()
        connected = second.connect()
        self.pass_time(8.0)
        self.assertNoResult(connected)
        self.assertGreater(second.diagnostics()["unanswered"], 0)
        first.disconnect()
        self.pass_time(6.0)
        self.successResultOf(connected)

    def test_drops_what_is_spoilt(self) -> None:
        """Garbage on the wire is counted and never raises; with a clean wire the dog is ready again."""
        driver = self.ready()
        self.dog.faults.garbage = 0.3
        self.dog.faults.split = True
        self.pass_time(10.0)
        self.assertGreater(driver.diagnostics()["bad_frames"], 0)
        self.dog.faults.garbage = 0.0
        self.pass_time(12.0)
        self.assertIn(driver.state, ("ready", "stopped"))

    def test_stands_noise_on_every_port(self) -> None:
        """Whatever bytes come on whichever port, nothing is raised, and the dog is ready again when they end."""
        self.ready()
        dice = random.Random(7)
        for _ in range(300):
            for client in list(self.dog.clients.values()):
                client.link.send(dice.randbytes(dice.randrange(1, 200)))
            self.pass_time(0.02)
        self.pass_time(12.0)
        self.assertEqual(self.drivers[0].state, "ready")
        self.assertGreater(self.drivers[0].diagnostics()["bad_frames"], 0)

    def test_stands_a_late_and_broken_wire(self) -> None:
        """Writes that come 100 ms late, in pieces, are the same dog."""
        self.dog.faults.split = True
        self.dog.faults.delay = 0.1
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(1.5)
        self.successResultOf(connected)
        self.assertEqual(driver.diagnostics()["bad_frames"], 0)

    def test_ages_where_readings_are_absurd(self) -> None:
        """Readings that cannot be are dropped and counted, and the last good one ages."""
        driver = self.ready()
        self.body.values = {"imu.ax": math.inf}
        self.pass_time(0.3)
        self.assertGreater(driver.diagnostics()["bad_frames"], 5)
        self.assertGreater(driver.diagnostics()["age"], 0.25)
        self.body.values = {}
        self.pass_time(0.1)
        self.assertLess(driver.diagnostics()["age"], 0.1)

    def test_counts_time_past_its_wrap(self) -> None:
        """The robot's clock goes on when its milliseconds begin anew."""
        self.dog.start_ms = 2**32 - 1200
        driver = self.ready()
        before = self.seen(driver).t_robot
        self.pass_time(1.0)
        self.near(self.seen(driver).t_robot - before, 1.0, 0.05)

    def test_looks_where_it_is_told(self) -> None:
        """Look turns the head within its limits, as far as the motors are on; wrong words are refused."""
        driver = self.make_driver()
        self.failureResultOf(driver.invoke("look", pan=0.5), LinkLost)
        driver.connect()
        self.pass_time(0.3)
        self.failureResultOf(driver.invoke("look", pan=0.5), NotEnabled)
        driver.enable()
        self.pass_time(0.3)
        done = self.successResultOf(driver.invoke("look", pan=0.768, tilt=-9.0, nod=0.0))
        self.assertEqual(done, {"ptz.pan": 0.768, "ptz.tilt": -1.309, "ptz.nod": 0.0})
        self.pass_time(0.1)
        self.assertAlmostEqual(float(self.seen(driver).values["ptz.pan"]), 0.768, places=5)
        self.assertAlmostEqual(float(self.seen(driver).values["ptz.tilt"]), -1.309, places=5)
        self.failureResultOf(driver.invoke("look", roll=1.0), Unsupported)
        self.failureResultOf(driver.invoke("look", pan=math.nan), Unsupported)
        self.failureResultOf(driver.invoke("warp"), Unsupported)

    def test_makes_sounds(self) -> None:
        """A sound of the dog is one command, and a file on the stick is selected by its name."""
        driver = self.ready()
        self.successResultOf(driver.invoke("yap"))
        self.successResultOf(driver.invoke("play", sound="mew.wav"))
        self.pass_time(0.1)
        self.assertEqual(self.dog.heard[-1][0], "6")
        self.assertEqual(self.dog.menu.played, ["MEW.WAV"])
        self.failureResultOf(driver.invoke("play", sound='x"\n!reset'), Unsupported)

    def test_tries_the_ports_of_a_dog_whose_menu_is_silent(self) -> None:
        """Main control that never answers keeps nobody from a dog whose servers run already."""
        self.dog.menu.running = {"estop", "state", "walk", "head"}
        self.dog.menu.answers = lambda data: b""  # type: ignore[method-assign]
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(2.0)
        self.assertNoResult(connected)
        self.pass_time(2.0)
        self.successResultOf(connected)

    def test_asks_again_for_a_server_that_ended(self) -> None:
        """A walk server that ended by itself, as that of Tekkotsu 5 does without a client, is selected again."""
        driver = self.ready()
        self.dog.menu.answers(b'!select "#Walk Remote Control"\n')
        self.pass_time(0.1)
        self.assertEqual(driver.state, "stale")
        self.pass_time(2.0)
        self.assertEqual(driver.state, "ready")

    def test_knows_no_sensors_of_another_model(self) -> None:
        """A model that is not known is driven, with its switch, its motion and no sensor that could be misread."""
        driver = self.ready()
        stranger = WorldState(T4, "ERS-210", 5, 6, (1.0,) * 40, (2.0,) * 8, (0.0,) * 8, (0.5,) * 18)
        self.drivers[-1]._on_world(stranger)
        values = self.seen(driver).values
        self.assertNotIn("range.near", values)
        self.assertIs(values["estop.engaged"], False)

    def test_stops_the_servers_that_it_started(self) -> None:
        """After disconnect the dog runs what it ran before, with its motors stopped."""
        driver = self.ready()
        self.assertIn("walk", self.dog.menu.running)
        driver.disconnect()
        self.pass_time(0.1)
        self.assertEqual(self.dog.menu.running, {"estop"})
        self.assertTrue(self.dog.is_engaged)
        self.assertEqual(self.dog.clients, {})


class OldAiboDriverTests(AiboDriverTests):
    """A dog of Tekkotsu 2: another world state, another menu, and the same contract."""

    dialect = T2


class _Way:
    """A way for datagrams to the emulated dog, through memory."""

    is_busy = False

    def __init__(self, dog: AiboEmulator, received: object) -> None:
        self._dog = dog
        self._received = received
        self.sent = 0

    def send(self, data: bytes) -> None:
        """To the dog."""
        self.sent += 1
        self._dog.datagram(data, self._received)  # type: ignore[arg-type]

    def close(self) -> None:
        """Nothing is left open."""


class _Ways:
    def __init__(self, dog: AiboEmulator) -> None:
        self.opened: list[_Way] = []
        self._dog = dog

    def open(self, host: str, port: int, received: object) -> _Way:
        self.opened.append(_Way(self._dog, received))
        return self.opened[-1]


class AiboCameraTests(_Case):
    """Pictures over both transports."""

    def pictures(self, transport: str, is_raw: bool = False, fps: float = 30.0) -> tuple[AiboDriver, AiboEmulator]:
        """A dog that films, and its driver, 2 s after the driver began."""
        clock = Clock()
        body = MemoryBody(jpeg=jpeg())
        dog = AiboEmulator(clock, body, random.Random(1), is_raw=is_raw)
        dog.start()
        options = {"host": "10.0.0.1", "camera_transport": transport, "camera_fps": fps}
        self.ways = _Ways(dog)
        driver = AiboDriver(options, "dog1", dog.connector(), clock, self.ways)
        driver.connect()
        clock.pump([STEP_S] * 500)
        self.clock = clock

        def end() -> None:
            driver.disconnect()
            clock.pump([STEP_S] * 10)
            dog.stop()
            clock.pump([STEP_S] * 10)
            self.assertEqual(clock.getDelayedCalls(), [])

        self.addCleanup(end)
        return driver, dog

    def test_films_over_both_transports(self) -> None:
        """Thirty JPEGs a second arrive over TCP, and over UDP after one request."""
        for transport in ("tcp", "udp"):
            driver, _ = self.pictures(transport)
            self.near(driver.diagnostics()["pictures"], 59, 3)
            newest = driver.observe()
            assert newest is not None and newest.frame is not None
            self.assertEqual((newest.frame.data, newest.frame.encoding), (jpeg(), "jpeg"))
            self.assertEqual((newest.frame.width, newest.frame.height), (104, 80))
        self.assertEqual(self.ways.opened[0].sent, 1)

    def test_films_bare_channels(self) -> None:
        """Uncompressed pictures become three planes of one size."""
        driver, _ = self.pictures("tcp", is_raw=True)
        newest = driver.observe()
        assert newest is not None and newest.frame is not None
        self.assertEqual((newest.frame.encoding, len(newest.frame.data)), ("yuv444", 3 * 104 * 80))

    def test_films_as_often_as_it_is_asked(self) -> None:
        """The pace can be chosen and changed, down to none at all, and up again."""
        driver, dog = self.pictures("tcp", fps=15.0)
        self.near(driver.diagnostics()["pictures"], 29, 2)
        driver.set_camera_fps(0.0)
        self.clock.pump([STEP_S] * 20)
        self.assertNotIn("camera", dog.menu.running)
        before = driver.diagnostics()["pictures"]
        self.clock.pump([STEP_S] * 250)
        self.assertEqual(driver.diagnostics()["pictures"], before)
        driver.set_camera_fps(30.0)
        self.clock.pump([STEP_S] * 500)
        self.assertGreater(driver.diagnostics()["pictures"] - before, 30)
        self.assertEqual(driver.camera_fps, 30.0)

    def test_films_on_when_somebody_stopped_the_server(self) -> None:
        """A camera server that says that it closes is started again, over either transport."""
        for transport in ("tcp", "udp"):
            driver, dog = self.pictures(transport)
            dog.menu.answers(b'!select "#Raw Cam Server"\n')
            self.assertNotIn("camera", dog.menu.running)
            before = driver.diagnostics()["pictures"]
            self.clock.pump([STEP_S] * 1000)
            self.assertGreater(driver.diagnostics()["pictures"], before + 30, transport)

    def test_stamps_pictures_with_the_time_of_the_rest(self) -> None:
        """A picture is as old as the observation that it comes with, within 0.1 s, after a reboot as well."""
        driver, dog = self.pictures("tcp")
        for _ in range(2):
            newest = driver.observe()
            assert newest is not None and newest.frame is not None
            self.near(newest.t_robot, newest.frame.t_robot, 0.1)
            dog.reboot()
            self.clock.pump([STEP_S] * 1000)

    def test_asks_again_when_datagrams_cease(self) -> None:
        """A dog that was switched off and on is asked for datagrams again, and spoilt ones are counted."""
        driver, dog = self.pictures("udp")
        dog.faults.garbage = 1.0
        self.clock.pump([STEP_S] * 100)
        dog.faults.garbage = 0.0
        self.assertGreater(driver.diagnostics()["bad_frames"], 0)
        dog.reboot()
        before = driver.diagnostics()["pictures"]
        self.clock.pump([STEP_S] * 1500)
        self.assertGreater(driver.diagnostics()["pictures"], before + 30)
