"""Tests of ``drivers.aibo.driver`` against the emulated dog, connected in memory."""

from __future__ import annotations

import math
import random
from typing import Any

from drivers.aibo.codec import T2, T4, WorldState
from drivers.aibo.driver import AiboDriver
from drivers.conformance import Conformance
from drivers.errors import LinkLost, NotEnabled, Unsupported
from sim.robots.emulator.aibo_dog import AiboEmulator
from swarmnode.driver.environment import WarningCollector
from tests.drivers.contract import RobotCase
from tests.webnode.picture import jpeg


class AiboCase(RobotCase):
    """An emulated dog."""

    STEP_S = 0.004
    kind = "aibo"
    options = {"host": "dog1", "camera": False}
    dialect = T4

    def build(self) -> None:
        self.dog = self.robot = AiboEmulator(self.clock, self.body, random.Random(1), self.dialect)
        self.dog.start()
        self.connector = self.dog.connector()


class AiboDriverTests(Conformance, AiboCase):
    """The driver of a Tekkotsu 4 dog passes the conformance tests and further tests of its functions."""

    def test_senses_what_an_ers7_has(self) -> None:
        """Observations contain ranges, accelerations, power, buttons, joints, switch, dialect and odometry."""
        self.body.values = {"range.near": 0.25, "power.level": 0.5, "imu.ax": 1.0}
        driver = self.ready()
        values = self.newest(driver).values
        self.assertEqual((values["range.near"], values["power.level"], values["imu.ax"]), (0.25, 0.5, 1.0))
        self.assertTrue(math.isnan(float(values["range.far"])))
        self.assertAlmostEqual(float(values["imu.az"]), 9.81, places=5)
        self.assertIs(values["estop.engaged"], False)
        self.assertEqual(values["mode"], self.dialect)
        self.assertIn("joint.NECK:pan.pos", values)
        driver.act({"base.vx": 0.1, "base.wz": 0.5}, self.permit(seconds=2.0))
        self.pass_time(1.0)
        values = self.newest(driver).values
        self.near(float(values["odom.x"]), self.body.x, 0.01)
        self.near(float(values["odom.yaw"]), self.body.yaw, 0.05)

    def test_says_a_live_walk_again_and_a_still_dog_nothing(self) -> None:
        """The driver repeats a walk before the dog's 3 s timer expires, and sends nothing to a dog at rest."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(4.5)
        self.assertGreater(self.true_speed(), 0.05)
        self.pass_time(1.0)
        self.assertEqual(self.true_speed(), 0.0)
        self.dog.received_commands.clear()
        self.pass_time(2.0)
        self.assertEqual(self.dog.received_commands, [])

    def test_stops_by_the_dogs_own_timer(self) -> None:
        """A dog that receives nothing over open links stops 3 s after the last command."""
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
        """A turn at full speed leaves no speed for walking, and the result of ``act`` shows this."""
        driver = self.ready()
        done = driver.act({"base.vx": 0.16, "base.vy": -0.103, "base.wz": 2.03 / 2}, self.permit())
        self.assertAlmostEqual(done["base.vx"], 0.08)
        self.assertAlmostEqual(done["base.vy"], -0.0515)
        self.assertEqual(driver.act({"base.wz": 9.0}, self.permit())["base.vx"], 0.0)

    def test_recovers_from_silence(self) -> None:
        """After half a second without a world state the driver is stale.

        When world states arrive again, the driver is ready and the dog is at rest.
        """
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
        """Invalid data is logged once, and again if invalid data follows valid data."""
        collector = WarningCollector()
        self.addCleanup(collector.close)
        self.ready()
        for lines in (1, 2):
            self.patch(self.dog, "_send_state", self._say_rubbish)
            self.dog.stop()
            self.dog.start()
            self.pass_time(60.0)
            self.assertEqual(len([line for line in collector.warnings if "invalid world state" in line]), lines)
            del self.dog._send_state
            self.dog.stop()
            self.dog.start()
            self.pass_time(8.0)
            self.assertEqual(self.drivers[0].state, "ready")

    def _say_rubbish(self) -> None:
        client = self.dog.clients.get("state")
        if client is not None:
            client.link.send(random.randbytes(40))

    def test_recovers_from_a_reboot_that_nobody_told(self) -> None:
        """After a reboot that the dog did not announce, the driver starts the dog's servers again."""
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
        """The loss of a required link stops the dog, and the driver reconnects within seconds."""
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
        """The dog's emergency stop button stops the dog; ``enable`` releases it, a reconnect does not."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=20.0))
        self.pass_time(0.1)
        self.dog.press_back_button()
        self.pass_time(0.1)
        self.assertEqual(self.true_speed(), 0.0)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.cut_link()
        self.pass_time(2.0)
        self.assertTrue(self.dog.is_engaged)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.dog.press_back_button()
        for _ in range(10):
            self.pass_time(self.STEP_S)
            self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.assertTrue(self.dog.is_engaged)
        enabled = driver.enable()
        self.pass_time(0.1)
        self.assertIs(self.successResultOf(enabled), True)

    def test_stops_motors_that_another_left_on(self) -> None:
        """Connecting to a dog with running motors stops the motors."""
        self.dog.press_back_button()
        driver = self.make_driver()
        driver.connect()
        self.pass_time(0.3)
        self.assertTrue(self.dog.is_engaged)

    def test_waits_for_a_port_that_another_client_holds(self) -> None:
        """Each port accepts one client, so a second driver is refused until the first driver has disconnected."""
        first = self.ready()
        second = self.make_driver()
        connected = second.connect()
        self.pass_time(8.0)
        self.assertNoResult(connected)
        self.assertGreater(second.diagnostics()["unanswered"], 0)
        first.disconnect()
        self.pass_time(6.0)
        self.successResultOf(connected)

    def test_stands_noise_on_every_port(self) -> None:
        """Random bytes on any port raise no exception, and the dog is ready again after they end."""
        self.ready()
        dice = random.Random(7)
        for _ in range(300):
            for client in list(self.dog.clients.values()):
                client.link.send(dice.randbytes(dice.randrange(1, 200)))
            self.pass_time(0.02)
        self.pass_time(12.0)
        self.assertEqual(self.drivers[0].state, "ready")
        self.assertGreater(self.drivers[0].diagnostics()["bad_frames"], 0)

    def test_ages_where_readings_are_absurd(self) -> None:
        """Out-of-range readings are dropped and counted, and the age of the last valid reading grows."""
        driver = self.ready()
        self.body.values = {"imu.ax": math.inf}
        self.pass_time(0.3)
        self.assertGreater(driver.diagnostics()["bad_frames"], 5)
        self.assertGreater(driver.diagnostics()["age"], 0.25)
        self.body.values = {}
        self.pass_time(0.1)
        self.assertLess(driver.diagnostics()["age"], 0.1)

    def test_counts_time_past_its_wrap(self) -> None:
        """The robot time continues when the dog's millisecond counter wraps."""
        self.dog.start_ms = 2**32 - 1200
        driver = self.ready()
        before = self.newest(driver).t_robot
        self.pass_time(1.0)
        self.near(self.newest(driver).t_robot - before, 1.0, 0.05)

    def test_looks_where_it_is_told(self) -> None:
        """``look`` moves the head within its limits when the motors are on; invalid arguments are refused."""
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
        self.assertAlmostEqual(float(self.newest(driver).values["ptz.pan"]), 0.768, places=5)
        self.assertAlmostEqual(float(self.newest(driver).values["ptz.tilt"]), -1.309, places=5)
        self.failureResultOf(driver.invoke("look", roll=1.0), Unsupported)
        self.failureResultOf(driver.invoke("look", pan=math.nan), Unsupported)
        self.failureResultOf(driver.invoke("warp"), Unsupported)

    def test_makes_sounds(self) -> None:
        """A built-in sound is one command, and a file on the memory stick is selected by its name."""
        driver = self.ready()
        self.successResultOf(driver.invoke("yap"))
        self.successResultOf(driver.invoke("play", sound="mew.wav"))
        self.pass_time(0.1)
        self.assertEqual(self.dog.received_commands[-1][0], "6")
        self.assertEqual(self.dog.menu.played_sounds, ["MEW.WAV"])
        self.failureResultOf(driver.invoke("play", sound='x"\n!reset'), Unsupported)

    def test_tries_the_ports_of_a_dog_whose_menu_is_silent(self) -> None:
        """If main control does not reply, the driver still connects to servers that are already running."""
        self.dog.menu.running = {"estop", "state", "walk", "head"}
        self.dog.menu.make_answer = lambda data: b""  # type: ignore[method-assign]
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(2.0)
        self.assertNoResult(connected)
        self.pass_time(2.0)
        self.successResultOf(connected)

    def test_knows_no_sensors_of_another_model(self) -> None:
        """A dog of an unknown model can be driven; it reports its emergency stop and motion, but no sensors."""
        driver = self.ready()
        stranger = WorldState(T4, "ERS-210", 5, 6, (1.0,) * 40, (2.0,) * 8, (0.0,) * 8, (0.5,) * 18)
        self.drivers[-1]._on_world_state(stranger)
        values = self.newest(driver).values
        self.assertNotIn("range.near", values)
        self.assertIs(values["estop.engaged"], False)

    def test_stops_the_servers_that_it_started(self) -> None:
        """``disconnect`` stops the motors and each server that the driver started."""
        driver = self.ready()
        self.assertIn("walk", self.dog.menu.running)
        driver.disconnect()
        self.pass_time(0.1)
        self.assertEqual(self.dog.menu.running, {"estop"})
        self.assertTrue(self.dog.is_engaged)
        self.assertEqual(self.dog.clients, {})


class OldAiboDriverTests(AiboDriverTests):
    """The driver of a Tekkotsu 2 dog, with another world state and menu, passes the same tests."""

    dialect = T2


class RecordingUdp:
    """A datagram path to the emulated dog, in memory, that records the datagrams."""

    is_busy = False

    def __init__(self, dog: AiboEmulator) -> None:
        self.sent = 0
        self._dog = dog
        self._received: Any = None

    def open(self, host: str, port: int, received: Any) -> RecordingUdp:
        self.sent, self._received = 0, received
        return self

    def send(self, data: bytes) -> None:
        self.sent += 1
        self._dog.on_datagram(data, self._received)

    def close(self) -> None:
        """Do nothing, because no resource is open."""


class AiboCameraTests(AiboCase):
    """Camera frames over both transports."""

    END_S = 0.04

    def film(self, transport: str, fps: float = 30.0) -> AiboDriver:
        """Return a driver of a new dog that has received camera frames for 2 s."""
        self.tearDown()
        self.setUp()
        self.body.jpeg = jpeg()
        self.udp = RecordingUdp(self.dog)
        options = {"host": "10.0.0.1", "camera_transport": transport, "camera_fps": fps}
        driver = AiboDriver(options, "dog1", self.connector, self.clock, self.udp)
        self.drivers.append(driver)
        driver.connect()
        self.pass_time(2.0)
        return driver

    def test_films_over_both_transports(self) -> None:
        """Thirty JPEGs per second arrive over TCP, and also over UDP after one request."""
        for transport in ("tcp", "udp"):
            driver = self.film(transport)
            self.near(driver.diagnostics()["pictures"], 59, 3)
            newest = self.newest(driver)
            assert newest.frame is not None
            self.assertEqual((newest.frame.data, newest.frame.encoding), (jpeg(), "jpeg"))
            self.assertEqual((newest.frame.width, newest.frame.height), (104, 80))
        self.assertEqual(self.udp.sent, 1)

    def test_films_as_often_as_it_is_asked(self) -> None:
        """The frame rate can be changed; a rate of zero stops the frames."""
        driver = self.film("tcp", 15.0)
        self.near(driver.diagnostics()["pictures"], 29, 2)
        driver.set_camera_fps(0.0)
        self.pass_time(0.08)
        self.assertNotIn("camera", self.dog.menu.running)
        before = driver.diagnostics()["pictures"]
        self.pass_time(1)
        self.assertEqual(driver.diagnostics()["pictures"], before)
        driver.set_camera_fps(30.0)
        self.pass_time(2)
        self.assertGreater(driver.diagnostics()["pictures"] - before, 30)
        self.assertEqual(driver.camera_fps, 30.0)

    def test_films_on_when_somebody_stopped_the_server(self) -> None:
        """A camera server that announces its end is started again, over TCP and over UDP."""
        for transport in ("tcp", "udp"):
            driver = self.film(transport)
            self.dog.menu.make_answer(b'!select "#Raw Cam Server"\n')
            self.assertNotIn("camera", self.dog.menu.running)
            before = driver.diagnostics()["pictures"]
            self.pass_time(4)
            self.assertGreater(driver.diagnostics()["pictures"], before + 30, transport)

    def test_stamps_pictures_with_the_time_of_the_rest(self) -> None:
        """The robot time of a frame is within 0.1 s of the robot time of its observation, also after a reboot."""
        driver = self.film("tcp")
        for _ in range(2):
            newest = self.newest(driver)
            assert newest.frame is not None
            self.near(newest.t_robot, newest.frame.t_robot, 0.1)
            self.dog.reboot()
            self.pass_time(4)

    def test_asks_again_when_datagrams_cease(self) -> None:
        """After a reboot the driver requests datagrams again; invalid datagrams are counted."""
        driver = self.film("udp")
        self.dog.faults.garbage = 1.0
        self.pass_time(0.4)
        self.dog.faults.garbage = 0.0
        self.assertGreater(driver.diagnostics()["bad_frames"], 0)
        self.dog.reboot()
        before = driver.diagnostics()["pictures"]
        self.pass_time(6)
        self.assertGreater(driver.diagnostics()["pictures"], before + 30)
