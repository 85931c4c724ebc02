"""Tests of the targets in ``benchmarks.dht.target``; no library runs."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.dht.library import OURS, OURS_IN_MEMORY
from benchmarks.dht.target import OPENDHT, TORRENT, check_targets


def measured() -> dict[str, Any]:
    """Return results of this project's node that reach each target."""
    operation = {"p50": 0.5, "max": 9.0, "per_s": 9000.0, "cpu_ms": 0.1, "datagrams": 2.0, "tried": 200, "failed": 0}
    lost = {part: {"found_percent": 100.0, "p95": 9.0, "max": 30.0} for part in ("a quarter", "a half")}
    return {
        "join_ms": [1.0, 2.0, None],
        "remote_get": operation,
        **{name: dict(operation) for name in ("put", "get", "gets", "puts")},
        "silent": lost,
        "killed": lost,
        "watch": {"p50": 0.5, "lost": 0},
        "space": {
            "put": {"p50": 1.0, "datagrams": 9},
            "crowd": {"found_percent": 100.0},
            "race": {"single_winner": 30, "of": 30},
            "wake": {"lost": 0},
        },
        "long": {"put": {"p50": 50.0}},
        "long_lossy": {"failed": 0},
    }


def row() -> dict[str, dict[str, Any]]:
    """Return a complete run that reaches each target."""
    peer = {"remote_get": {"p50": 1.0}, "put": {"p50": 1.0}, "watch": {"p50": 1.0}}
    peer |= {name: {"per_s": 6000.0, "cpu_ms": 1.0} for name in ("gets", "puts")}
    return {OURS: measured(), OURS_IN_MEMORY: measured(), TORRENT: peer, OPENDHT: peer | {"put": {"p50": 2.0}}}


class TargetTests(SynchronousTestCase):
    def reached(self, results: dict[str, Any], verdict: bool | None) -> list[int]:
        """Return the numbers of the targets with the result ``verdict``."""
        return [one.number for one in check_targets(results) if one.is_met is verdict]

    def test_all_are_reached(self) -> None:
        """If all figures are good enough, all fourteen targets are reached."""
        self.assertEqual(self.reached(row(), True), list(range(1, 15)))

    def test_what_was_not_measured_is_not_known(self) -> None:
        """The result of a target is unknown if its figure or the figure of the compared library is missing."""
        self.assertEqual(self.reached({}, None), list(range(1, 15)))
        alone = {OURS: measured()}
        self.assertEqual(self.reached(alone, None), [1, 2, 3, 4, 6, 10, 14])
        results = row()
        del results[OURS]
        self.assertEqual(self.reached(results, None), [14])

    def test_each_figure_counts(self) -> None:
        """If one figure is insufficient, exactly the targets that depend on this figure are missed."""
        spoilt: list[tuple[tuple[str, ...], Any, list[int]]] = [
            (("remote_get", "p50"), 0.91, [1]),
            (("put", "p50"), 0.91, [2, 14]),
            (("gets", "per_s"), 7199.0, [3]),
            (("puts", "per_s"), 8399.0, [4]),
            (("puts", "per_s"), 1619.0, [4, 14]),
            (("put", "datagrams"), 18.1, [5]),
            (("puts", "cpu_ms"), 0.81, [6]),
            (("join_ms",), [3.5], [7]),
            (("silent", "a half", "p95"), 20.1, [8]),
            (("killed", "a quarter", "found_percent"), 99.0, [9]),
            (("killed", "a quarter", "max"), 1001.0, [9]),
            (("killed", "trouble"), {"a half": "too slow"}, [9]),
            (("get", "failed"), 1, [9]),
            (("watch", "lost"), 1, [10]),
            (("space", "put", "datagrams"), 53, [11]),
            (("space", "race", "single_winner"), 29, [12]),
            (("long", "put", "p50"), 93.0, [13]),
        ]
        for path, value, missed in spoilt:
            results = row()
            found = results[OURS] = measured()
            for step in path[:-1]:
                found[step] = dict(found[step])
                found = found[step]
            found[path[-1]] = value
            self.assertEqual(self.reached(results, False), missed, path)

    def test_in_words(self) -> None:
        """The text of a target contains the measured figure and the required value."""
        limits = [str(limit) for verdict in check_targets({OURS: measured()})[:3] for limit in verdict.limits]
        self.assertEqual(limits, ["p50 ms 0.50 (at most ?)"] * 2 + ["gets/s 9,000 (at least ?)"])
