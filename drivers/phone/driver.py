"""Driver of a visitor's phone, which senses and is moved by its visitor; the web node provides its pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.base import SensingDriver
from drivers.option import Manifest
from drivers.phone.option import Options, make_description, parse_options
from drivers.reading import Description, Frame, Value

MANIFEST = Manifest()

TARGET_KEYS = ("target.bearing", "target.distance")
"""Position of the red target as detected by the page: radians, left positive, and metres; NaN if not seen."""


class PhoneDriver(SensingDriver):
    """One phone; its page sends pictures and measurements."""

    STALE_S = 0.5

    def __init__(self, options: Options | Mapping[str, object], clock: IReactorTime) -> None:
        options = options if isinstance(options, Options) else parse_options(options)
        super().__init__(make_description(options), "the phone", clock)
        self._started_at = 0.0

    def process_picture(self, jpeg: bytes, width: int, height: int, values: Mapping[str, float]) -> None:
        """Publish one picture with its measurements; ignored before ``connect`` and after ``disconnect``."""
        if self.state in ("idle", "closed"):
            return
        if self.state != "ready" and self.state != "stopped":
            self._up()
        self._counts["frames"] += 1
        self._counts["bytes"] += len(jpeg)
        t = self._clock.seconds() - self._started_at
        sensed: dict[str, Value] = {**dict.fromkeys(TARGET_KEYS, math.nan), **values}
        self._observed(sensed, t, frame=Frame(self._counts["frames"], width, height, jpeg, t))

    def _open(self) -> None:
        self._started_at = self._clock.seconds()

    def _close(self) -> Deferred[None]:
        return succeed(None)


def make_driver(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Any) -> PhoneDriver:
    """Return a driver of a phone; it opens no link, because pictures are passed to ``process_picture``."""
    return PhoneDriver(options, clock)


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the phone that ``options`` describe."""
    return make_description(parse_options(options))
