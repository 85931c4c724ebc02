"""PhoneDriver: a visitor's phone, whose looks come in from outside; it senses, and moves as its visitor does."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.driver import Permit
from drivers.errors import LinkLost, NotEnabled, Unsupported, UsageError
from drivers.gate import Gate
from drivers.phone.option import Options, checked, described
from drivers.reading import Action, Description, Frame, Observation, Value

STALE_S = 0.5
"""Without a look for so long the phone counts as stale."""
SIGHT = ("target.bearing", "target.distance")
"""Where the phone's own page sees the red target: radians, left positive, and metres; NaN while it sees none."""


class PhoneDriver:
    """One phone, whose page sends what it sees; everything happens on the reactor's thread.

    ``state`` says ``ready`` while looks come, ``stale`` while they do not (none for ``STALE_S``), and ``stopped`` after
    ``disable``.  It has no motors: ``enable`` is always granted while looks come, and of actions there is only ``{}``.
    """

    log = Logger()

    def __init__(self, options: Options | Mapping[str, object], clock: IReactorTime) -> None:
        self._options = options if isinstance(options, Options) else checked(options)
        self._description = described(self._options)
        self._clock = clock
        self._gate = Gate()
        self._connecting: Deferred[Description] | None = None
        self._is_open = False
        self._is_closed = False
        self._is_disabled = False
        self._newest: Observation | None = None
        self._began = 0.0
        self._seen: list[Callable[[Observation], None]] = []
        self._counts = dict.fromkeys(("frames", "bad_frames", "bytes", "reconnects"), 0)

    @property
    def description(self) -> Description:
        """What the phone is; valid before ``connect``."""
        return self._description

    @property
    def state(self) -> str:
        """Where the link stands: ``idle connecting ready stale stopped closed``."""
        if self._is_closed:
            return "closed"
        if not self._is_open:
            return "idle"
        if self._newest is None:
            return "connecting"
        if self._clock.seconds() - self._newest.t_host > STALE_S:
            return "stale"
        return "stopped" if self._is_disabled else "ready"

    @property
    def token(self) -> int:
        """The highest token that was obeyed."""
        return self._gate.token or 0

    def connect(self) -> Deferred[Description]:
        """Wait for the first look; a phone that falls silent is there again with its next one."""
        if self._is_closed:
            return fail(UsageError("this driver was disconnected; make a new one"))
        if self._is_open:
            return fail(UsageError("this driver is connected already, or on its way"))
        self._is_open = True
        self._began = self._clock.seconds()
        self._connecting = Deferred(lambda _: self._close())
        return self._connecting

    def disconnect(self) -> Deferred[None]:
        """Take no look any more.  May be called twice."""
        self._close()
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.errback(LinkLost("the phone left before its first look"))
        return succeed(None)

    def enable(self) -> Deferred[bool]:
        """Nothing has to be switched on; fails with ``LinkLost`` while no look comes."""
        return self._switch(True)

    def disable(self) -> Deferred[bool]:
        """Refuse all actions until ``enable``; fails with ``LinkLost`` while no look comes."""
        return self._switch(False)

    def act(self, action: Action, permit: Permit) -> Action:
        """Do nothing, under a permit as lawful as any; raises ``Unsupported`` for everything but ``{}``."""
        for key in action:
            raise Unsupported(f"a phone has no action {key!r}; whoever holds it moves it")
        if self.state != "ready":
            raise NotEnabled(f"the phone is {self.state}, not ready; wait for its next look, or call enable()")
        self._gate.admit(permit, self._clock.seconds())
        return {}

    def stop(self) -> Action:
        """There is no motion to stop; safe in any state."""
        self._gate.close()
        return {}

    def observe(self) -> Observation | None:
        """The newest observation; never blocks."""
        return self._newest

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``seen`` at each observation; call what is returned to end that."""
        self._seen.append(seen)

        def end() -> None:
            if seen in self._seen:
                self._seen.remove(seen)

        return end

    def diagnostics(self) -> dict[str, float]:
        """Counters: frames, bad frames (none: they are refused before), bytes, reconnects, ``age`` of the newest in s.

        Also the commands ``accepted`` here, and those refused as ``lower token`` or ``late``.
        """
        counts: dict[str, float] = {**self._counts, "accepted": self._gate.accepted, **self._gate.refused}
        counts["age"] = math.inf if self._newest is None else self._clock.seconds() - self._newest.t_host
        return counts

    # -- the phone's side -------------------------------------------------------------------------------------------

    def look(self, jpeg: bytes, width: int, height: int, values: Mapping[str, float]) -> None:
        """Take one picture and what was measured with it; before ``connect`` and after the end it is dropped."""
        if not self._is_open or self._is_closed:
            return
        if self.state == "stale":
            self._counts["reconnects"] += 1
        self._counts["frames"] += 1
        self._counts["bytes"] += len(jpeg)
        now = self._clock.seconds()
        frame = Frame(self._counts["frames"], width, height, jpeg, now - self._began)
        sensed: dict[str, Value] = {**dict.fromkeys(SIGHT, math.nan), **values}
        observation = self._newest = Observation(now, now - self._began, sensed, frame=frame)
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.callback(self._description)
        for seen in list(self._seen):
            try:
                seen(observation)
            except Exception:
                self.log.failure("a subscriber of a phone failed")

    def _switch(self, on: bool) -> Deferred[bool]:
        if self.state not in ("ready", "stopped"):
            return fail(LinkLost(f"the phone is {self.state}; connect first, or wait for its next look"))
        self._is_disabled = not on
        self.stop()
        return succeed(True)

    def _close(self) -> None:
        self._is_closed = True
        self._gate.close()
