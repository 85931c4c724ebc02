"""Choose the robots of the demonstration and the settings of their drivers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LOOPBACK = "127.0.0.1"
CAMERA_FPS = 15
ROBOT_SETS = {
    "aibo": ("aibo", "aibo", "aibo"),
    "bittle": ("bittle", "bittle", "bittle"),
    "create2": ("create2", "create2", "create2"),
    "mixed": ("aibo", "create2", "bittle"),
    "rosbridge": ("rosbridge", "rosbridge", "rosbridge"),
    "sim": ("sim", "sim", "sim"),
}
"""The kinds of the three robots for each value of ``--robot``."""
MAX_PORTS = 8
"""Maximum number of TCP ports of a robot and its parts."""
AIBO_SERVICES = ("main", "estop", "state", "walk", "head", "camera")


@dataclass(frozen=True)
class Robot:
    """One robot: the driver table of its node, and further options for the simulator that emulates it."""

    kind: str
    model: str
    description: str
    options: Mapping[str, Any]
    parts: tuple[Mapping[str, Any], ...] = ()
    emulator_options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def driver_table(self) -> dict[str, Any]:
        """The table ``[driver]`` of the robot's node."""
        return {"kind": self.kind, "options": self.options, **({"parts": self.parts} if self.parts else {})}

    @property
    def simulator_table(self) -> dict[str, Any]:
        """The robot's table for the simulator."""
        return {**self.driver_table, **self.emulator_options}


def make_robots(
    robot_set: str, names: tuple[str, ...], folder: Path, ports: Iterator[int], yard_port: int
) -> dict[str, Robot]:
    """Return the robots of ``robot_set`` by name, with ports from ``ports`` and serial devices in ``folder``."""
    makers: dict[str, Callable[[str], Robot]] = {
        "aibo": lambda name: _make_aibo(name, ports),
        "bittle": lambda name: _make_bittle(name, folder, ports),
        "create2": lambda name: _make_create2(name, folder, ports),
        "rosbridge": lambda name: _make_rosbridge(ports),
        "sim": lambda name: _make_simulated(name, yard_port),
    }
    return {name: makers[kind](name) for name, kind in zip(names, ROBOT_SETS[robot_set], strict=True)}


def _make_aibo(name: str, ports: Iterator[int]) -> Robot:
    served = {service: next(ports) for service in AIBO_SERVICES}
    options = {"host": LOOPBACK, "camera_fps": CAMERA_FPS, "camera_width": 208, "ports": served}
    # dog3 runs the older Tekkotsu; a driver detects the version.
    more = {"dialect": "T2"} if name.endswith("3") else {}
    stripes = _describe_stripes(name)
    return Robot("aibo", "AIBO ERS-7", f"With {stripes}", options, (_make_compass(ports),), more)


def _make_bittle(name: str, folder: Path, ports: Iterator[int]) -> Robot:
    options = {"port": str(folder / f"{name}.tty"), "board": "biboard", "ultrasonic": [16, 17]}
    return Robot(
        "bittle", "Petoi Bittle", "With a camera on its back", options, (_make_camera(ports), _make_compass(ports))
    )


def _make_create2(name: str, folder: Path, ports: Iterator[int]) -> Robot:
    options = {"port": str(folder / f"{name}.tty")}
    return Robot(
        "create2", "iRobot Create 2", "With a camera on its back", options, (_make_camera(ports), _make_compass(ports))
    )


def _make_rosbridge(ports: Iterator[int]) -> Robot:
    camera = {"camera_fps": CAMERA_FPS, "camera_width": 208, "camera_height": 160, "camera_lens": 56.9}
    options = {"host": LOOPBACK, "port": next(ports), "image_topic": "/camera/image_raw/compressed", **camera}
    return Robot("rosbridge", "ROS 2 robot", "Behind rosbridge", options, (_make_compass(ports),))


def _make_simulated(name: str, yard_port: int) -> Robot:
    options = {"host": LOOPBACK, "port": yard_port, "robot": name, "camera_fps": CAMERA_FPS}
    stripes = _describe_stripes(name)
    return Robot("sim", "simulated ERS-7", f"With {stripes}", options)


def _describe_stripes(name: str) -> str:
    return f"{name[-1]} yellow stripe" + ("s" if name[-1] != "1" else "")


def _make_camera(ports: Iterator[int]) -> Mapping[str, Any]:
    lens = {"width": 208, "height": 160, "lens": 56.9, "ahead": 0.105, "fps": CAMERA_FPS}
    return {"kind": "camera", "options": {"url": f"http://{LOOPBACK}:{next(ports)}/stream", **lens}}


def _make_compass(ports: Iterator[int]) -> Mapping[str, Any]:
    return {"kind": "compass", "options": {"host": LOOPBACK, "port": next(ports)}}
