"""Samples: how a run's figures went over time, looked at a bounded number of times."""

from __future__ import annotations

from sim.team.run import Run

MOST = 240
"""Samples of a run; where it takes longer than was thought, every other one is dropped."""
FIGURES_EVERY = 6
"""The workloads' figures are asked for in every sixth sample only: some of them look at all there is."""

Series = dict[str, list[tuple[float, float]]]


class Samples:
    """What was there at moments of the team's time; by name, (moment, value)."""

    def __init__(self) -> None:
        self.series: Series = {}
        self._every = 0.0
        self._next = 0.0
        self._taken = 0
        self._before = (0.0, 0, 0)

    def looked(self, run: Run) -> None:
        """Take a sample where it is time for one."""
        now = run.team.clock.seconds()
        if now < self._next:
            return
        self._every = self._every or run.expected_end / MOST
        self._next = now + self._every
        self._taken += 1
        team, (then, sent, size) = run.team, self._before
        total = team.board.counters["sent"]
        bytes_sent = sum(team.traffic(place).sent_bytes for place in team.places)
        passed, alive = now - then, len(team.living)
        self._add("nodes alive", now, alive)
        self._add("nodes in the network", now, len(team.inside()))
        if passed and alive:
            self._add("datagrams per node and second", now, (total - sent) / passed / alive)
            self._add("bytes per node and second", now, (bytes_sent - size) / passed / alive)
        self._before = now, total, bytes_sent
        if run.began_at is not None and self._taken % FIGURES_EVERY == 0:
            for figure in run.figures():
                if figure.is_exact and figure.value is not None:
                    self._add(figure.name, now, figure.value)
        if self._taken > 2 * MOST:
            self.series = {name: points[::2] for name, points in self.series.items()}
            self._every *= 2
            self._taken //= 2

    def _add(self, name: str, now: float, value: float) -> None:
        self.series.setdefault(name, []).append((round(now, 3), value))
