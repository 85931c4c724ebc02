"""Options of the kind "sim"; each error says how to correct it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from drivers.option import Fps, Port, convert_options
from drivers.reading import Description

DEFAULT_PORT = 7400


@dataclass(frozen=True)
class Options:
    """The address of the simulator, the name of the robot, and the frame rate (0: no camera)."""

    robot: Annotated[str, Meta(min_length=1, max_length=32, examples=["dog1"])]
    host: Annotated[str, Meta(min_length=1)] = "127.0.0.1"
    port: Port = DEFAULT_PORT
    camera_fps: Fps = 15.0
    camera: bool = True

    @property
    def wanted_fps(self) -> float:
        """The requested frame rate in pictures per second."""
        return self.camera_fps if self.camera else 0.0


def parse_options(table: Mapping[str, object]) -> Options:
    """Convert and check ``table``; raise ``UsageError`` with the key, the problem and the remedy."""
    return convert_options("sim", table, Options)


def make_description(options: Options) -> Description:
    """Return the description of a simulated dog: an ERS-7 with Tekkotsu's walking speeds and sensor ranges."""
    capabilities: dict[str, Mapping[str, float | str]] = {
        "base2d": {},
        "odometry": {},
        "compass": {},
        "ranger": {"max": 1.5},
        "imu": {},
        "power": {},
    }
    rates = {"state": 31.25}
    if options.wanted_fps > 0:
        capabilities["camera"] = {"width": 208, "height": 160, "fps": 30, "fov_h_deg": 56.9, "fov_v_deg": 45.2}
        rates["camera"] = options.wanted_fps
    return Description(
        kind="aibo-ers7",
        model="ERS-7 (simulated)",
        capabilities=capabilities,
        limits={"base.vx": (-0.156, 0.160), "base.vy": (-0.103, 0.103), "base.wz": (-2.03, 2.03)},
        radius=0.12,
        rates=rates,
    )
