"""Pilot: keys to motion, with a dead man's switch: a key counts for 0.4 s, and without one the robot stands.

Pure but for the driver that it commands; the moment is an argument.
"""

from __future__ import annotations

from drivers.driver import Driver, Permit
from drivers.errors import DriverError
from drivers.reading import Action

KEY_S = 0.4
"""A key counts for so long; holding it repeats it more often than that."""
FIRST_SHARE, LEAST_SHARE, STEP = 0.3, 0.1, 0.1
"""Of the robot's limits: how fast it is driven at first, at least, and how much more or less a key makes it."""
MOVES = {
    "w": ("base.vx", 1),
    "s": ("base.vx", -1),
    "a": ("base.wz", 1),
    "d": ("base.wz", -1),
    "q": ("base.vy", 1),
    "e": ("base.vy", -1),
}
"""Key to axis and direction: forward, back, turn left and right, aside left and right."""
HELP = "w s: forward, back   a d: turn   q e: aside   space: stop   + -: speed   m: motors on   x: end"
ENDS = ("x", "\x03", "\x04", "")


class Pilot:
    """Drives ``driver``; ``said`` is what it did or why it could not, for the eyes of whoever presses the keys.

    Commands carry the highest token that the robot has seen: this is a person at the robot, outside of any team.
    """

    def __init__(self, driver: Driver) -> None:
        self.said = ""
        self.share = FIRST_SHARE
        self.done: Action = {}
        self._driver = driver
        self._held: dict[str, tuple[float, float]] = {}

    @property
    def is_moving(self) -> bool:
        """Whether a key counts now."""
        return bool(self._held)

    def press(self, key: str, now: float) -> bool:
        """Take a key; False where it ends the drive."""
        if key in ENDS:
            self.rest()
            return False
        if key == " ":
            self.rest()
            self.said = "stop"
        elif key in ("+", "="):
            self._set_share(self.share + STEP)
        elif key in ("-", "_"):
            self._set_share(self.share - STEP)
        elif key.lower() in MOVES:
            self._move(key.lower(), now)
        return True

    def tick(self, now: float) -> None:
        """Let what was pressed too long ago count no more; the robot stands once nothing does."""
        was = dict(self._held)
        self._held = {axis: held for axis, held in was.items() if held[1] > now}
        if was and not self._held:
            self.rest()
        elif was != self._held:
            self._act(now)

    def rest(self) -> None:
        """Stand still now."""
        self._held.clear()
        self.done = self._driver.stop()

    def _move(self, key: str, now: float) -> None:
        axis, sign = MOVES[key]
        ends = self._driver.description.limits.get(axis)
        if ends is None:
            self.said = f"it has no {axis}"
            return
        self._held[axis] = (self.share * (ends[1] if sign > 0 else ends[0]), now + KEY_S)
        self._act(now)

    def _act(self, now: float) -> None:
        limits = self._driver.description.limits
        action = {axis: self._held[axis][0] if axis in self._held else 0.0 for axis in limits if axis in _AXES}
        deadline = max(until for _, until in self._held.values())
        try:
            self.done = self._driver.act(action, Permit(max(1, self._driver.token), deadline))
            self.said = ""
        except DriverError as error:
            self._held.clear()
            self.said = " ".join(str(error).split())

    def _set_share(self, share: float) -> None:
        self.share = min(max(round(share, 2), LEAST_SHARE), 1.0)
        self.said = f"{100 * self.share:.0f} % of its speed"


_AXES = {axis for axis, _ in MOVES.values()}
