"""PhoneDriver: a visitor's phone, whose looks come in from outside; it senses, and moves as its visitor does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.base import SensingDriver
from drivers.option import Manifest
from drivers.phone.option import Options, checked, described
from drivers.reading import Description, Frame, Value

MANIFEST = Manifest()

SIGHT = ("target.bearing", "target.distance")
"""Where the phone's own page sees the red target: radians, left positive, and metres; NaN while it sees none."""


class PhoneDriver(SensingDriver):
    """One phone, whose page sends what it sees."""

    STALE_S = 0.5

    def __init__(self, options: Options | Mapping[str, object], clock: IReactorTime) -> None:
        options = options if isinstance(options, Options) else checked(options)
        super().__init__(described(options), "the phone", clock)
        self._began = 0.0

    def look(self, jpeg: bytes, width: int, height: int, values: Mapping[str, float]) -> None:
        """Take one picture and what was measured with it; before ``connect`` and after the end it is dropped."""
        if self.state in ("idle", "closed"):
            return
        if self.state != "ready" and self.state != "stopped":
            self._up()
        self._counts["frames"] += 1
        self._counts["bytes"] += len(jpeg)
        t = self._clock.seconds() - self._began
        sensed: dict[str, Value] = {**dict.fromkeys(SIGHT, math.nan), **values}
        self._observed(sensed, t, frame=Frame(self._counts["frames"], width, height, jpeg, t))

    def _open(self) -> None:
        self._began = self._clock.seconds()

    def _close(self) -> Deferred[None]:
        return succeed(None)


def make_driver(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Any) -> PhoneDriver:
    """A driver of a phone; it opens no link, as looks are handed to it."""
    return PhoneDriver(options, clock)


def describe(options: Mapping[str, object], name: str) -> Description:
    """What that phone is."""
    return described(checked(options))
