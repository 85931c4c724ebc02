"""Tests of the inputs of ``swarm driver``: options, serial devices, units, the catalogue and link problems."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace

from twisted.internet import error
from twisted.internet.task import Clock
from twisted.logger import Logger
from twisted.python.failure import Failure
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import UsageError
from drivers.link import TcpConnector
from swarmnode.driver.catalogue import (
    KindEntry,
    SerialDevice,
    format_kind_entries,
    format_serial_devices,
    list_kind_entries,
    list_serial_devices,
)
from swarmnode.driver.environment import RecordingConnector, WarningCollector
from swarmnode.driver.formatting import format_reading
from swarmnode.driver.selection import parse_options


class OptionTests(SynchronousTestCase):
    def test_words_become_options(self) -> None:
        """A value that is valid TOML is parsed as TOML; any other value is text. Dots in a key create tables."""
        words = ["host=192.168.0.51", "port=7400", "camera=false", "speed=[0.1, 0.2]", "ports.walk=1", "ports.head=2"]
        self.assertEqual(
            parse_options([*words, "name=a=b", "when=2020-01-01", "empty="]),
            {
                **{"host": "192.168.0.51", "port": 7400, "camera": False, "speed": [0.1, 0.2]},
                **{"ports": {"walk": 1, "head": 2}, "name": "a=b", "when": "2020-01-01", "empty": ""},
            },
        )

    def test_other_words_are_refused(self) -> None:
        """An argument that is not KEY=VALUE, and a key that is both a value and a table, are rejected."""
        for words in (["host"], ["=1"], ["a..b=1"], ["ports=1", "ports.walk=2"]):
            self.assertIn("--option", str(self.assertRaises(UsageError, parse_options, words)))


class SerialDeviceTests(SynchronousTestCase):
    def test_serial_devices_are_shown(self) -> None:
        """Each serial device is listed with its description and the next command, or the remedy if access is denied."""
        found = list_serial_devices(
            lambda: [("/dev/ttyUSB1", "FTDI"), ("/dev/ttyUSB0", "")], lambda device: "1" in device
        )
        self.assertEqual(found, [SerialDevice("/dev/ttyUSB0", "", False), SerialDevice("/dev/ttyUSB1", "FTDI", True)])
        told = "\n".join(format_serial_devices(found))
        self.assertIn("/dev/ttyUSB1  FTDI\n  swarm driver probe --kind bittle --option port=/dev/ttyUSB1", told)
        self.assertEqual(told.count("no permission"), 1)

    def test_nothing_is_said_as_well(self) -> None:
        """Without serial devices the output says that a robot in the network needs its address."""
        self.assertIn("needs its address", "\n".join(format_serial_devices([])))


class UnitTests(SynchronousTestCase):
    def test_readings_have_their_units(self) -> None:
        """Values have SI units according to their key. Angles are also in degrees, and NaN is described in words."""
        for key, value, told in (
            ("base.vx", 0.1, "0.100 m/s"),
            ("base.wz", -0.5, "-0.500 rad/s"),
            ("odom.yaw", math.pi, "3.142 rad  (180 degrees)"),
            ("joint.NECK:pan.pos", 0.0, "0.000 rad  (0 degrees)"),
            ("joint.NECK:pan.effort", 0.5, "0.500"),
            ("range.far", math.nan, "nothing in range"),
            ("compass.heading", math.nan, "unknown"),
            ("power.level", 0.5, "50 %"),
            ("power.volts", 7.4, "7.400 V"),
            ("imu.az", 9.8, "9.800 m/s2"),
            ("bump.left", True, "yes"),
            ("mode", "safe", "safe"),
            ("safety.event", "", "-"),
        ):
            self.assertEqual(format_reading(key, value), told)


class CatalogueTests(SynchronousTestCase):
    def test_says_what_is_missing(self) -> None:
        """A kind with a missing library is listed with the package to install; other kinds are ready."""
        bare = {entry.kind: entry for entry in list_kind_entries(lambda library: False)}
        self.assertIn("pip install 'swarm-node[serial]'", bare["create2"].needs)
        self.assertEqual((bare["create2"].is_ready, bare["aibo"].is_ready), (False, True))
        self.assertTrue(all(entry.is_ready for entry in list_kind_entries(lambda library: True)))

    def test_names_the_broken_kinds_of_others(self) -> None:
        """A driver of another distribution is listed with its docstring, or as broken if it cannot be imported."""
        folder = Path(self.mktemp()).resolve()
        (folder / "odd-1.dist-info").mkdir(parents=True)
        (folder / "odd-1.dist-info" / "METADATA").write_text("Name: odd\nVersion: 1\n")
        entries = "[swarm_node.drivers]\nodd = odd_of_tests:Odd\ntorn = no_such_module_of_tests:Torn\n"
        (folder / "odd-1.dist-info" / "entry_points.txt").write_text(entries)
        (folder / "odd_of_tests.py").write_text('class Odd:\n    """An odd robot.\n\n    And more.\n    """\n')
        self.patch(sys, "path", [str(folder), *sys.path])
        self.addCleanup(sys.modules.pop, "odd_of_tests", None)
        found = {entry.kind: entry for entry in list_kind_entries()}
        self.assertEqual(found["odd"], KindEntry("odd", "An odd robot (odd_of_tests:Odd)"))
        self.assertIn("no_such_module_of_tests", found["torn"].problem)
        told = format_kind_entries([found["odd"], found["torn"]])
        self.assertEqual(told[0], "odd   An odd robot (odd_of_tests:Odd)")
        self.assertTrue(told[1].startswith("torn  broken: driver 'torn' cannot be loaded"))


class RecordingConnectorTests(SynchronousTestCase):
    def test_remembers_what_is_wrong_with_each_line(self) -> None:
        """Serial devices and addresses use different connectors.

        The problem of a link is reported until the problem ends.
        """
        line = SimpleNamespace(problem="it is off")
        tcp = SimpleNamespace(connect=lambda host, port, client: line)
        cable = SimpleNamespace()
        serial = SimpleNamespace(connect=lambda host, port, client: cable)
        connector = RecordingConnector(tcp, serial)
        self.assertIs(connector.connect("dog1", 10020, None), line)
        self.assertIs(connector.connect("/dev/ttyUSB0", 115200, None), cable)
        self.assertEqual(connector.list_problems(), ["dog1:10020: it is off"])
        line.problem = ""
        self.assertEqual(connector.list_problems(), [])

    def test_knows_a_serial_device_by_its_name(self) -> None:
        """Every path is a serial device, including a link; a host name that begins like a device name is not."""
        tcp = SimpleNamespace(connect=lambda host, port, client: "tcp")
        serial = SimpleNamespace(connect=lambda host, port, client: "serial")
        connector = RecordingConnector(tcp, serial)
        for name in ("/dev/ttyUSB0", "/tmp/create2", "./create2", "COM3", r"\\.\COM12"):
            self.assertEqual(connector.connect(name, 115200, None), "serial", name)
        for name in ("dog1", "192.168.0.51", "fe80::1", "COMpass.lan", "COM-board"):
            self.assertEqual(connector.connect(name, 10020, None), "tcp", name)

    def test_keeps_one_line_to_each_place(self) -> None:
        """Repeated connections to the same robot do not increase the memory use."""
        tcp = SimpleNamespace(connect=lambda host, port, client: SimpleNamespace(problem=client))
        connector = RecordingConnector(tcp, None)
        for number in range(1000):
            connector.connect("dog1", 80, f"problem {number}")
        self.assertEqual(len(vars(connector)["_reconnectors"]), 1)
        self.assertEqual(connector.list_problems(), ["dog1:80: problem 999"])

    def test_hears_the_warnings_of_drivers(self) -> None:
        """Each warning of a driver is recorded once; messages of other modules and of lower levels are ignored."""
        collector = WarningCollector()
        for namespace in ("drivers.aibo.driver", "drivers.aibo.driver", "middleware.node"):
            Logger(namespace).warn("{robot}: it\nis off", robot=namespace[:7])
        Logger("drivers.link").info("nothing")
        collector.close()
        Logger("drivers.link").warn("too late")
        self.assertEqual(collector.warnings, ["drivers: it is off"])

    def test_tcp_line_says_why_there_is_no_link(self) -> None:
        """A refused connection, a timeout and similar errors are reported with a remedy until the link is open."""
        connected: list[object] = []

        class Reactor(Clock):
            def connectTCP(self, *arguments: object, **_: object) -> object:  # noqa: N802 (Twisted's)
                connected.append(arguments)
                return SimpleNamespace(state="disconnected", connect=lambda: None)

        line = TcpConnector(Reactor()).connect("dog1", 1, SimpleNamespace())
        told = vars(line)
        for problem, remedy in (
            (error.ConnectionRefusedError(), "nothing listens at this port"),
            (error.TCPTimedOutError(), "is it switched on"),
            (error.TimeoutError(), "is it switched on"),
            (error.NoRouteError(), "is this machine in its network"),
            (error.DNSLookupError("dog1"), "write a numeric address"),
            (OSError("out of\nsorts"), "out of sorts"),
        ):
            line.clientConnectionFailed(told["connector"], Failure(problem))  # type: ignore[attr-defined]
            self.assertIn(remedy, told["problem"])
        line.buildProtocol(None)  # type: ignore[attr-defined]
        self.assertEqual(told["problem"], "")
