"""Tests of ``drivers.registry``, and of the options of each kind of robot."""

from __future__ import annotations

import math
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

import drivers
from drivers.errors import UsageError
from drivers.registry import create_driver, describe, list_built_in_kinds, list_kinds

NEEDED: dict[str, dict[str, object]] = {
    "aibo": {"host": "dog1"},
    "bittle": {"port": "/dev/ttyUSB0"},
    "camera": {"source": "video.avi"},
    "compass": {"host": "board"},
    "create2": {"port": "/dev/ttyUSB0"},
}
"""The required options of each kind."""
NO_NUMBERS = (True, math.nan)
WRONG: list[tuple[str, str, object]] = [
    *((kind, "colour", "red") for kind in list_built_in_kinds()),
    *(("aibo", "host", value) for value in (7, "")),
    *(("aibo", "camera_fps", value) for value in (31, *NO_NUMBERS)),
    *(("aibo", "speed", value) for value in ([1.0], [0.0, 1.0, 1.0, 1.0], "fast")),
    *(("aibo", "ports", value) for value in (7, {"walk": 0}, {"warp": 1})),
    *(("aibo", "camera", "no"), ("aibo", "camera_transport", "pigeon"), ("aibo", "camera_width", 416)),
    *(("bittle", key, 7) for key in ("port", "host")),
    *(("bittle", "host", "10.0.0.1"), ("bittle", "baud", 9600), ("bittle", "http_port", 0), ("bittle", "board", "esp")),
    *(("bittle", "gaits", value) for value in ({}, {"w f": [0.1, 0]}, {"wkF": [0.1]}, {"wkF": [math.nan, 0]})),
    *(("bittle", "gaits", {"vtL": [0, 1]}), ("bittle", "ultrasonic", [16])),
    *(("camera", "source", value) for value in (-1, "", True, "a\nb")),
    *(("camera", "width", 8), ("camera", "width", 20.5), ("camera", "fps", 0), ("camera", "fps", "10")),
    *(("camera", "fps", math.nan), ("camera", "lens", True), ("camera", "quality", 96), ("camera", "ahead", 6)),
    *(("compass", "host", ""), ("compass", "device", 7), ("compass", "port", 0), ("compass", "port", True)),
    *(("compass", "baud", 300), ("compass", "baud", "4800"), ("compass", "mounted_deg", 361), ("compass", "rate", 0)),
    *(("compass", "mounted_deg", math.nan), ("compass", "variation_deg", True)),
    *(("create2", "port", 7), ("create2", "port", ""), ("create2", "baud", 9600), ("create2", "baud", "fast")),
    *(("create2", "mode", "passive"), ("create2", "mode", ["safe"]), ("create2", "max_speed", 0.6)),
    *(("create2", "max_speed", True), ("create2", "max_turn", math.nan)),
    *(("phone", "width", 8), ("phone", "height", 641), ("phone", "width", 20.0), ("phone", "orientation", 1)),
    *(("rosbridge", "host", ""), ("rosbridge", "port", 0), ("rosbridge", "port", True), ("rosbridge", "path", "x")),
    *(("rosbridge", "path", "/a b"), ("rosbridge", "ros", 3), ("rosbridge", "velocity_topic", "")),
    *(("rosbridge", "velocity_type", "x"), ("rosbridge", "odometry_topic", "odom"), ("rosbridge", "camera_fps", 31)),
    *(("rosbridge", "max_vx", math.nan), ("rosbridge", "max_vx", 0), ("rosbridge", "max_wz", "2")),
    *(("rosbridge", "battery_full", True), ("rosbridge", "battery_full", 10), ("rosbridge", "scan_turn", 1e3)),
    *(("rosbridge", "services", value) for value in ({"a b": "/x"}, {"a": "x"}, 1)),
    *(("sim", "robot", 7), ("sim", "robot", ""), ("sim", "host", ""), ("sim", "port", "7400"), ("sim", "port", 0)),
    *(("sim", "camera_fps", value) for value in (31, *NO_NUMBERS)),
    ("sim", "camera", "no"),
]
"""Kind, option and a value that is not allowed."""
INCOMPLETE: list[tuple[str, dict[str, object], str]] = [
    ("aibo", {}, "host"),
    ("aibo", {"host": "dog1.local", "camera_transport": "udp"}, "numeric"),
    ("bittle", {}, "port"),
    ("bittle", {"host": "10.0.0.1"}, "board"),
    ("compass", {}, "either"),
    ("compass", {"host": "a", "device": "b"}, "either"),
    ("create2", {}, "/dev/ttyUSB0"),
    ("rosbridge", {"odometry_topic": "", "scan_topic": ""}, "odometry_topic"),
]
"""Inconsistent options, and a part of the error message."""


class RegistryTests(SynchronousTestCase):
    """The registry creates drivers from the names of their kinds."""

    def test_makes_a_driver(self) -> None:
        """A new driver of each kind is idle, and has the description that the registry gives."""
        connector: Any = object()
        for kind in list_built_in_kinds():
            options = NEEDED.get(kind, {})
            driver = create_driver(kind, options, "dog2", Clock(), connector)
            self.assertEqual((driver.state, driver.description), ("idle", describe(kind, options, "dog2")), kind)

    def test_every_kind_is_complete(self) -> None:
        """Each driver package is found, has a docstring, and has both functions that the registry calls."""
        folder = Path(drivers.__file__).parent
        self.assertEqual(sorted(list_built_in_kinds()), sorted(file.parent.name for file in folder.glob("*/driver.py")))
        for kind in list_built_in_kinds():
            module = import_module(f"drivers.{kind}.driver")
            missing = [name for name in ("make_driver", "describe") if not callable(getattr(module, name, None))]
            self.assertEqual((kind, missing), (kind, []))
            self.assertTrue(import_module(f"drivers.{kind}").__doc__, kind)

    def test_names_the_known_kinds(self) -> None:
        """An unknown kind raises a usage error that lists the known kinds."""
        for ask in (lambda: create_driver("warp", {}, "dog1", Clock()), lambda: describe("warp", {})):
            self.assertIn("known are " + ", ".join(list_kinds()), str(self.assertRaises(UsageError, ask)))

    def test_names_the_wrong_option(self) -> None:
        """Each invalid option is refused; one line contains its key and a remedy."""
        for kind, key, value in WRONG:
            line = str(self.assertRaises(UsageError, describe, kind, {**NEEDED.get(kind, {}), key: value}))
            self.assertIn(key, line)
            self.assertNotIn("\n", line)
        for kind, options, words in INCOMPLETE:
            self.assertIn(words, str(self.assertRaises(UsageError, describe, kind, options)))

    def test_leaves_the_camera_out_of_the_description(self) -> None:
        """A dog without its camera has no camera capability."""
        self.assertIn("camera", describe("sim", {}).capabilities)
        self.assertNotIn("camera", describe("sim", {"camera": False}).capabilities)
        self.assertNotIn("camera", describe("sim", {"camera_fps": 0}).capabilities)

    def test_imports_no_kind_before_it_is_asked_for(self) -> None:
        """The registry imports a driver only when it is used; the sim driver imports no OpenCV, NumPy or physics."""
        script = (
            "import sys; from twisted.internet.task import Clock\n"
            "import drivers.registry as r; assert 'drivers.sim.driver' not in sys.modules\n"
            "r.describe('sim', {}); r.create_driver('sim', {}, 'dog1', None)\n"
            "for kind in ('create2', 'bittle'): r.create_driver(kind, {'port': '/dev/x'}, 'robot', Clock())\n"
            "import drivers.sim.client; unwanted = {'cv2', 'numpy', 'pymunk', 'serial', 'twisted.internet.reactor'}\n"
            "heavy = unwanted & set(sys.modules)\n"
            "assert not heavy, heavy"
        )
        root = Path(drivers.__file__).parents[1]
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False, cwd=root
        )
        self.assertEqual((done.returncode, done.stderr), (0, ""))
