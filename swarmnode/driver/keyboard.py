"""Motion by keys, with a dead man's switch: a key has effect for 0.4 s; without a key the robot stops.

The time is an argument; the driver is the only side effect.
"""

from __future__ import annotations

from drivers.driver import Driver, Permit
from drivers.errors import DriverError
from drivers.reading import Action

KEY_HOLD_S = 0.4
"""Seconds for which a key has effect; a held key repeats more often."""
INITIAL_SHARE, MIN_SHARE, SHARE_STEP = 0.3, 0.1, 0.1
"""Speed as a share of the robot's limits: initial value, minimum, and step per key."""
KEY_AXES = {
    "w": ("base.vx", 1),
    "s": ("base.vx", -1),
    "a": ("base.wz", 1),
    "d": ("base.wz", -1),
    "q": ("base.vy", 1),
    "e": ("base.vy", -1),
}
"""Key to axis and direction: forward, back, turn left and right, sideways left and right."""
HELP = "w s: forward, back   a d: turn   q e: sideways   space: stop   + -: speed   m: motors on   x: end"
END_KEYS = ("x", "\x03", "\x04", "")


class KeyboardController:
    """Controls ``driver`` by keys; ``message`` is the last message for the user.

    Commands carry the highest fencing token that the robot has accepted, because the user acts without a lease.
    """

    def __init__(self, driver: Driver) -> None:
        self.message = ""
        self.share = INITIAL_SHARE
        self.last_motion: Action = {}
        self._driver = driver
        self._active_motions: dict[str, tuple[float, float]] = {}

    @property
    def is_moving(self) -> bool:
        """Whether a key has effect now."""
        return bool(self._active_motions)

    def press(self, key: str, now: float) -> bool:
        """Process a key; returns False if it ends the session."""
        if key in END_KEYS:
            self.stop()
            return False
        if key == " ":
            self.stop()
            self.message = "stop"
        elif key in ("+", "="):
            self._set_share(self.share + SHARE_STEP)
        elif key in ("-", "_"):
            self._set_share(self.share - SHARE_STEP)
        elif key.lower() in KEY_AXES:
            self._move(key.lower(), now)
        return True

    def tick(self, now: float) -> None:
        """Expire keys; stop the robot when no key has effect."""
        was = dict(self._active_motions)
        self._active_motions = {axis: held for axis, held in was.items() if held[1] > now}
        if was and not self._active_motions:
            self.stop()
        elif was != self._active_motions:
            self._act(now)

    def stop(self) -> None:
        """Stop the robot now."""
        self._active_motions.clear()
        self.last_motion = self._driver.stop()

    def _move(self, key: str, now: float) -> None:
        axis, sign = KEY_AXES[key]
        ends = self._driver.description.limits.get(axis)
        if ends is None:
            self.message = f"this robot cannot move along {axis}"
            return
        self._active_motions[axis] = (self.share * (ends[1] if sign > 0 else ends[0]), now + KEY_HOLD_S)
        self._act(now)

    def _act(self, now: float) -> None:
        limits = self._driver.description.limits
        action = {
            axis: self._active_motions[axis][0] if axis in self._active_motions else 0.0
            for axis in limits
            if axis in _AXES
        }
        deadline = max(until for _, until in self._active_motions.values())
        try:
            self.last_motion = self._driver.act(action, Permit(max(1, self._driver.token), deadline))
            self.message = ""
        except DriverError as error:
            self._active_motions.clear()
            self.message = " ".join(str(error).split())

    def _set_share(self, share: float) -> None:
        self.share = min(max(round(share, 2), MIN_SHARE), 1.0)
        self.message = f"speed {100 * self.share:.0f} %"


_AXES = {axis for axis, _ in KEY_AXES.values()}
