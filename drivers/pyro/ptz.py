"""Ptz: a head that looks about; positions are shares of how far it can turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from drivers.pyro.device import Device


class Pose(NamedTuple):
    """Pan (-1 to 1, left positive), tilt (-1 to 0, down negative), zoom (none), roll (0 to 1: the second tilt)."""

    pan: float
    tilt: float
    zoom: float
    roll: float


AXES = {"pan": "pan", "tilt": "tilt", "roll": "nod"}
"""What the brain calls it, and what the robot does."""


class Ptz(Device):
    """A head; ``look`` turns joints to radians, ``limits`` are those of the robot (``pan_min``, ``pan_max`` ...)."""

    supports = ("pan", "tilt", "roll")

    def __init__(self, look: Callable[[Mapping[str, float]], None], limits: Mapping[str, float | str]) -> None:
        super().__init__("ptz")
        self._look = look
        self._limits = limits

    def pan(self, share: float) -> None:
        """Look to the left (to 1) or to the right (to -1)."""
        self._turn(pan=share)

    def tilt(self, share: float) -> None:
        """Look down (to -1) or ahead (0)."""
        self._turn(tilt=share)

    def roll(self, share: float) -> None:
        """Turn the second tilt."""
        self._turn(roll=share)

    def zoom(self, share: float) -> None:
        """There is none."""

    def center(self) -> None:
        """Look ahead."""
        self._turn(pan=0.0, tilt=0.0, roll=0.0)

    def setPose(self, pan: float, tilt: float, zoom: float = 0.0, roll: float | None = None) -> None:
        """Turn all at once; the zoom is ignored."""
        self._turn(pan=pan, tilt=tilt, **({} if roll is None else {"roll": roll}))

    @property
    def pose(self) -> Pose:
        """Where the robot says that it looks."""
        told = {axis: self._share(joint, float(self.values.get(f"ptz.{joint}", 0.0))) for axis, joint in AXES.items()}
        return Pose(told["pan"], told["tilt"], 0.0, told["roll"])

    def _turn(self, **shares: float) -> None:
        self._look({AXES[axis]: self._radians(AXES[axis], share) for axis, share in shares.items()})

    def _radians(self, joint: str, share: float) -> float:
        share = max(-1.0, min(1.0, share))
        return share * self._limit(joint, "max") if share > 0.0 else -share * self._limit(joint, "min")

    def _share(self, joint: str, radians: float) -> float:
        limit = self._limit(joint, "max") if radians > 0.0 else -self._limit(joint, "min")
        return max(-1.0, min(1.0, radians / limit)) if limit else 0.0

    def _limit(self, joint: str, end: str) -> float:
        return float(self._limits.get(f"{joint}_{end}", 0.0))
