"""Tests of ``drivers.registry`` and of the options of the kinds."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

import drivers
from drivers.errors import UsageError
from drivers.registry import built_in_kinds, describe, driver_for, kinds


class RegistryTests(SynchronousTestCase):
    """Kind to driver."""

    def test_makes_a_driver(self) -> None:
        """The driver of kind sim is made idle, described, and named after the device where the options do not say."""
        driver = driver_for("sim", {"port": 7400}, "dog2", Clock())
        self.assertEqual(driver.state, "idle")
        self.assertEqual(driver.description, describe("sim", {"port": 7400}))
        self.assertEqual(driver.description.kind, "aibo-ers7")

    def test_every_kind_is_complete(self) -> None:
        """Each package of a driver is found, is described in one line, and has both functions of the registry."""
        folder = Path(drivers.__file__).parent
        self.assertEqual(sorted(built_in_kinds()), sorted(file.parent.name for file in folder.glob("*/driver.py")))
        for kind in built_in_kinds():
            module = import_module(f"drivers.{kind}.driver")
            missing = [name for name in ("make_driver", "describe") if not callable(getattr(module, name, None))]
            self.assertEqual((kind, missing), (kind, []))
            self.assertTrue(import_module(f"drivers.{kind}").__doc__, kind)

    def test_names_the_known_kinds(self) -> None:
        """An unknown kind is a usage error that lists the kinds there are."""
        for ask in (lambda: driver_for("warp", {}, "dog1", Clock()), lambda: describe("warp", {})):
            self.assertIn("known are " + ", ".join(kinds()), str(self.assertRaises(UsageError, ask)))

    def test_names_the_wrong_option(self) -> None:
        """Each wrong option is refused in one line that names its key and what to write."""
        for key, value in (
            ("robot", 7),
            ("robot", ""),
            ("host", ""),
            ("port", "7400"),
            ("port", 0),
            ("camera_fps", 31),
            ("camera_fps", True),
            ("camera_fps", float("nan")),
            ("camera", "no"),
            ("colour", "red"),
        ):
            line = str(self.assertRaises(UsageError, describe, "sim", {key: value}))
            self.assertIn(key, line)
            self.assertNotIn("\n", line)

    def test_leaves_the_camera_out_of_the_description(self) -> None:
        """A dog with its camera off does not offer one."""
        self.assertIn("camera", describe("sim", {}).capabilities)
        self.assertNotIn("camera", describe("sim", {"camera": False}).capabilities)
        self.assertNotIn("camera", describe("sim", {"camera_fps": 0}).capabilities)

    def test_imports_no_kind_before_it_is_asked_for(self) -> None:
        """The registry alone loads no driver, and the sim driver loads no OpenCV, NumPy or physics."""
        script = (
            "import sys; from twisted.internet.task import Clock\n"
            "import drivers.registry as r; assert 'drivers.sim.driver' not in sys.modules\n"
            "r.describe('sim', {}); r.driver_for('sim', {}, 'dog1', None)\n"
            "for kind in ('create2', 'bittle'): r.driver_for(kind, {'port': '/dev/x'}, 'robot', Clock())\n"
            "import drivers.sim.operator; unwanted = {'cv2', 'numpy', 'pymunk', 'serial', 'twisted.internet.reactor'}\n"
            "heavy = unwanted & set(sys.modules)\n"
            "assert not heavy, heavy"
        )
        root = Path(drivers.__file__).parents[1]
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False, cwd=root
        )
        self.assertEqual((done.returncode, done.stderr), (0, ""))
