"""Connection test of a robot: connect for some seconds without motion, and report readings and problems."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from drivers.driver import Driver
from drivers.reading import Observation, Value
from drivers.timer import Timer
from swarmnode.driver.formatting import format_reading, make_json_safe

SILENCE_TIMEOUT_S = 8.0
"""Seconds after which the probe of a silent robot ends; the AIBO is the slowest to report an error, after 5 s."""
PROBLEM_TIMEOUT_S = 3.0
"""Seconds after which the probe of a silent robot with a known problem ends."""
MIN_RATE_SHARE = 0.7
"""Share of the specified rate below which a robot is reported as slow."""
REPORTED_KEYS = (
    "mode",
    "firmware",
    "skill.running",
    "safety.event",
    "estop.engaged",
    "power.level",
    "power.volts",
    "power.charging",
)
"""Readings that are part of the result."""


@dataclass(frozen=True)
class ProbeResult:
    """The result of a probe.

    ``first`` is the time in seconds until the first observation, or None; ``rate`` and ``promised`` are
    observations per second; ``problems`` are sentences with the remedy.
    """

    kind: str
    first: float | None
    state: str = ""
    rate: float = 0.0
    promised: float = 0.0
    keys: tuple[str, ...] = ()
    readings: Mapping[str, Value] = field(default_factory=dict)
    picture: str = ""
    pictures: float = 0.0
    counts: Mapping[str, float] = field(default_factory=dict)
    problems: tuple[str, ...] = ()

    @property
    def is_reachable(self) -> bool:
        """Whether the robot was observed and is still connected."""
        return self.first is not None and self.state in ("ready", "stopped")

    def to_data(self) -> dict[str, Any]:
        """Return plain data for JSON; NaN and infinities become None."""
        data = {**asdict(self), "is_there": self.is_reachable}
        return data | {"readings": make_json_safe(self.readings), "counts": make_json_safe(self.counts)}


class Probe:
    """One probe of ``driver``, which is disconnected at the end; ``problems`` returns the known problems."""

    def __init__(
        self, driver: Driver, clock: IReactorTime, seconds: float, problems: Callable[[], Sequence[str]]
    ) -> None:
        self._driver = driver
        self._clock = clock
        self._seconds = seconds
        self._problems = problems
        self._started_at = clock.seconds()
        self._first_s: float | None = None
        self._observation_count = 0
        self._pictures: set[int] = set()
        self._keys: dict[str, None] = {}
        self._connect_error = ""
        self._timer = Timer(clock)
        self._is_over = False
        self._result: Deferred[ProbeResult] = Deferred()

    def start(self) -> Deferred[ProbeResult]:
        """Begin; fires with the result, and never fails."""
        self._timer.set(PROBLEM_TIMEOUT_S, self._on_silence)
        self._driver.subscribe(self._on_observation)
        self._driver.connect().addCallbacks(self._on_connected, self._on_refused)
        return self._result

    def end(self) -> Deferred[Any]:
        """End now with the data so far; fires when the robot is disconnected."""
        if not self._is_over:
            self._is_over = True
            self._timer.cancel()
            finding = self._make_result()
            self._driver.disconnect().addBoth(lambda _: self._result.callback(finding))
        return self._result

    def _on_connected(self, _: object) -> None:
        self._first_s = self._clock.seconds() - self._started_at
        self._observation_count = 0
        self._pictures.clear()
        self._timer.set(self._seconds, self.end)

    def _on_silence(self) -> None:
        if self._problems():
            self.end()
        else:
            self._timer.set(SILENCE_TIMEOUT_S - PROBLEM_TIMEOUT_S, self.end)

    def _on_refused(self, failure: Failure) -> None:
        if not self._is_over:
            self._connect_error = " ".join(failure.getErrorMessage().split())
            self.end()

    def _on_observation(self, seen: Observation) -> None:
        self._observation_count += 1
        self._keys |= dict.fromkeys(seen.values)
        if seen.frame is not None:
            self._pictures.add(seen.frame.seq)

    def _make_result(self) -> ProbeResult:
        body, newest = self._driver.description, self._driver.observe()
        duration = self._clock.seconds() - self._started_at - (self._first_s or 0.0)
        rate = self._observation_count / duration if self._first_s is not None and duration > 0 else 0.0
        promised = body.rates.get("state", max(body.rates.values(), default=0.0))
        values = {} if newest is None else newest.values
        frame = None if newest is None else newest.frame
        problems = [*([self._connect_error] if self._connect_error else []), *self._problems()]
        if self._first_s is None and not problems:
            problems.append(
                f"no data within {SILENCE_TIMEOUT_S:g} s; check the options, and that the robot is switched on"
            )
        if self._first_s is not None and rate < MIN_RATE_SHARE * promised:
            problems.append(
                f"the robot is slow: {rate:.1f} of {promised:g} observations per second; check the radio link"
            )
        if "camera" in body.capabilities and self._first_s is not None and not self._pictures:
            problems.append("no picture received from the camera; check that the camera is on")
        return ProbeResult(
            kind=body.kind,
            first=self._first_s,
            state=self._driver.state,
            rate=rate,
            promised=promised,
            keys=tuple(sorted(self._keys)),
            readings={key: values[key] for key in REPORTED_KEYS if key in values},
            picture="" if frame is None else f"{frame.width} x {frame.height} {frame.encoding}",
            pictures=len(self._pictures) / duration if duration > 0 else 0.0,
            counts=self._driver.diagnostics(),
            problems=tuple(dict.fromkeys(problems)),
        )


def format_result(finding: ProbeResult) -> Iterator[str]:
    """Return the result as lines of text."""
    if finding.first is None:
        yield f"{finding.kind}: not reached"
    else:
        yield f"{finding.kind}: first observation after {finding.first:.2f} s"
        promised = f" of {finding.promised:g}" if finding.promised else ""
        yield f"  state         {finding.state}"
        yield f"  rate          {finding.rate:.1f}{promised} per second"
        for key, value in finding.readings.items():
            yield f"  {key:13} {format_reading(key, value)}"
        if finding.picture:
            yield f"  pictures      {finding.picture}, {finding.pictures:.1f} per second"
        yield f"  bad frames    {finding.counts.get('bad_frames', 0):g} of {finding.counts.get('frames', 0):g}"
        yield f"  reconnects    {finding.counts.get('reconnects', 0):g}"
        yield f"  readings      {' '.join(finding.keys) or 'only pictures'}"
    for problem in finding.problems:
        yield f"  ! {problem}"
