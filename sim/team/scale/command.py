"""``sim scale``: measure cost and latencies of teams of several sizes, and plot them next to theoretical values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from middleware.errors import BadSetting
from sim.team.command import EXIT_INTERRUPTED, EXIT_MISSED, Environment
from sim.team.memory import check_memory
from sim.team.metric import Metric, format_table
from sim.team.scale.curve import CURVES
from sim.team.scale.drawing import draw_svg
from sim.team.scale.fork import run_in_fork
from sim.team.scale.markdown import format_markdown
from sim.team.scale.measurement import MeasurementStopped, ProgressCallbacks, SizeResult, SurveySettings, measure_size
from sim.team.scale.measurement_file import MeasurementFile
from sim.team.scenario import Scenario

SIZES = "3,10,30,100,300,1000,3000,10000"
MIN_NODES, MAX_NODES = 3, 100_000


Measure = Callable[[int, SurveySettings, ProgressCallbacks], SizeResult]


def measure_in_fork(nodes: int, settings: SurveySettings, watcher: ProgressCallbacks) -> SizeResult:
    """Measure a team of that size in a separate process; raises ``MeasurementStopped``.

    In the same process, memory freed by one team would be reused by the next team, which would seem to need less.
    """
    return run_in_fork(
        partial(measure_size, nodes, settings, watcher), MeasurementStopped, is_stopped=watcher.is_stopped
    )


def run_scale(arguments: Sequence[str], world: Environment, measure: Measure = measure_in_fork) -> int:
    """Measure the sizes that are missing in the file, print and plot all; return 1 if a target is missed.

    Raises ``BadSetting``.
    """
    args = _parse_arguments(arguments)
    sizes = _parse_sizes(args.nodes)
    out = Path(args.out)
    for key, value in (("--takeovers", args.takeovers), ("--swarm-most", args.swarm_most)):
        if value < 0:
            raise BadSetting("command line", key, f"must be 0 or more, is {value}", f"write {key} 100")
    settings = SurveySettings(seed=args.seed, takeovers=args.takeovers, swarm_most=args.swarm_most)
    record = MeasurementFile(out / "scale.json", settings)
    record.prepare()
    record.read()
    watcher = ProgressCallbacks(lambda line: _say(world, line), world.is_stopped)
    for nodes in sizes:
        check_memory(Scenario(nodes=nodes), world.read)
        if nodes in record.sizes:
            world.err.write(f"{nodes:,} nodes: already measured\n")
            continue
        try:
            result = measure(nodes, settings, watcher)
        except MeasurementStopped:
            break
        record.add(result)
        world.out.write(
            f"\n{nodes:,} nodes, {result.cpu:,.0f} s of the processor\n{format_table(apply_targets(result))}\n"
        )
        for line in result.violations:
            world.out.write(f"violated  {line}\n")
        world.out.flush()
        _draw(out, record.sizes, settings)
    _draw(out, record.sizes, settings)
    found = [figure for result in record.sizes.values() for figure in apply_targets(result)]
    missed = [figure for figure in found if figure.holds is False]
    world.out.write(f"\n{len(found)} figures, {len(missed)} missed; {out / 'scale.json'}, {out / 'scale.svg'}\n")
    if world.is_stopped():
        return EXIT_INTERRUPTED
    return EXIT_MISSED if missed or any(result.violations for result in record.sizes.values()) else 0


def apply_targets(result: SizeResult) -> list[Metric]:
    """Return the figures of one size with the targets for that size."""
    targets = {curve.metric: curve.get_target(result.nodes) for curve in CURVES}
    return [metric.with_target(targets.get(metric.name)) for metric in result.metrics]


def collect_points(sizes: Mapping[int, SizeResult]) -> dict[str, list[tuple[int, float]]]:
    """Return the values of each figure at the measured sizes, by name."""
    found: dict[str, list[tuple[int, float]]] = {}
    for nodes in sorted(sizes):
        for metric in sizes[nodes].metrics:
            if metric.value is not None and math.isfinite(metric.value):
                found.setdefault(metric.name, []).append((nodes, metric.value))
    return found


def _draw(out: Path, sizes: Mapping[int, SizeResult], settings: SurveySettings) -> None:
    measured = ", ".join(f"{nodes:,}" for nodes in sorted(sizes))
    note = f"seed {settings.seed}; measured at {measured} nodes, all in one process in virtual time"
    (out / "scale.svg").write_text(draw_svg(CURVES, collect_points(sizes), note), encoding="utf-8")
    (out / "table.md").write_text(
        f"# Scale: the figures\n\n{format_markdown(CURVES, collect_points(sizes))}", encoding="utf-8"
    )


def _say(world: Environment, line: str) -> None:
    world.err.write(f"{line}\n")
    world.err.flush()


def _parse_sizes(text: str) -> list[int]:
    try:
        sizes = [int(word) for word in text.split(",")]
    except ValueError:
        sizes = []
    if not sizes or not all(MIN_NODES <= nodes <= MAX_NODES for nodes in sizes):
        problem = f"must be numbers from {MIN_NODES} to {MAX_NODES:,}, is {text!r}"
        raise BadSetting("command line", "--nodes", problem, f"write --nodes {SIZES}")
    return sorted(set(sizes))


def _parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    default = SurveySettings()
    parser = argparse.ArgumentParser(
        prog="sim scale",
        description="Measure cost and latencies of teams of several sizes, and draw them with theoretical values.",
        epilog="Example: sim scale --nodes 10,100,1000 --out run/scale",
    )
    parser.add_argument("--nodes", default=SIZES, help="sizes of the teams, separated by commas (default %(default)s)")
    parser.add_argument(
        "--out", default="docs/scale", help="folder of scale.json, scale.svg and table.md (default %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=default.seed, help="seed of all random numbers (default 1)")
    parser.add_argument(
        "--takeovers", type=int, default=default.takeovers, help="number of lease holders killed (default %(default)s)"
    )
    parser.add_argument(
        "--swarm-most",
        type=int,
        default=default.swarm_most,
        help="size of the largest team of whole nodes, for the directory (default %(default)s)",
    )
    return parser.parse_args(arguments)
