"""``sim run``: run a scenario and check its targets and invariants."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from middleware.errors import BadSetting
from sim.team.load.catalogue import LOADS
from sim.team.membership import MEMBERSHIP
from sim.team.memory import Read, check_memory, measure_resident_bytes
from sim.team.picture import draw_svg
from sim.team.progress import Progress
from sim.team.report import Cost, Samples, Trace, format_json, format_text, make_repeat_command
from sim.team.run import Run
from sim.team.scenario import Scenario, find_position, list_names, load_scenario, make_remedy
from sim.team.workload import WorkloadKinds

KINDS: WorkloadKinds = {"standing": MEMBERSHIP, **LOADS}
EXIT_MISSED, EXIT_INTERRUPTED = 1, 130


@dataclass
class Environment:
    """The environment of a command; tests replace it.

    ``wall`` and ``cpu`` return seconds; ``columns`` is the width of the terminal, 0 without one; ``is_stopped`` returns
    whether the user has asked to stop; ``on_allocated`` is called when most of a run's memory is allocated.
    """

    out: TextIO
    err: TextIO
    wall: Callable[[], float]
    cpu: Callable[[], float]
    read: Read
    columns: int = 0
    is_stopped: Callable[[], bool] = field(default=lambda: False)
    on_allocated: Callable[[], None] = field(default=lambda: None)


def run(arguments: Sequence[str], world: Environment, kinds: WorkloadKinds = KINDS) -> int:
    """Run the scenario in the arguments; return 1 if a target or invariant is not met. Raises ``BadSetting``."""
    args = _parse_arguments(arguments)
    changes = {} if args.nodes is None else {"nodes": args.nodes}
    scenario = load_scenario(args.scenario, {name: kind.settings for name, kind in kinds.items()}, changes)
    check_memory(scenario, world.read)
    line = make_repeat_command(args.scenario, args.seed, args.nodes)
    began, cpu = world.wall(), world.cpu()
    memory = lambda: measure_resident_bytes(world.read)  # noqa: E731
    progress, samples = Progress(world.err, world.columns, world.wall, memory), Samples()

    def looked(run: Run) -> bool:
        samples.update(run)
        return False

    def watched(run: Run) -> bool:
        progress.update(run)
        return world.is_stopped()

    scenario_run = Run(scenario, args.seed, kinds, looked, world.on_allocated, watched, world.wall)
    check_targets(scenario, [metric.name for metric in scenario_run.collect_metrics()], args.scenario)
    faults: list[tuple[float, str]] = []
    with ExitStack() as files:
        # The files are opened before the run, so a missing folder is reported immediately and not after an hour.
        json_out = _open_file(args.json, "--json", files)
        trace_out = _open_file(args.trace, "--trace", files)
        picture_out = _open_file(args.picture, "--picture", files)
        scenario_run.team.event_listeners.append(
            lambda now, what, _, more: faults.append((now, more)) if what == "fault" else None
        )
        trace = None if trace_out is None else Trace(trace_out)
        if trace is not None:
            trace.begin(scenario=scenario.name, seed=args.seed, nodes=scenario.nodes, again=line)
            scenario_run.team.event_listeners.append(trace.write_event)
        outcome = scenario_run.run()
        progress.close()
        cost = Cost(world.cpu() - cpu, world.wall() - began, memory())
        if trace is not None:
            trace.end(partial=outcome.is_partial, hash=outcome.digest)
        if json_out is not None:
            json_out.write(format_json(scenario, outcome, cost, line, samples.series))
        if picture_out is not None:
            title = f"{scenario.name}, {scenario.nodes:,} nodes, seed {args.seed}"
            picture_out.write(draw_svg(title + (" (partial)" if outcome.is_partial else ""), samples.series, faults))
        world.out.write(format_text(scenario, outcome, cost, line))
    if outcome.is_partial:
        return EXIT_INTERRUPTED
    return EXIT_MISSED if outcome.missed or outcome.violations else 0


def check_targets(scenario: Scenario, known: Sequence[str], origin: str) -> None:
    """Raise ``BadSetting`` for a target whose name is not in ``known``, the names of all figures."""
    for name, _ in scenario.targets:
        if name not in known:
            place = find_position(origin, "targets", name)
            raise BadSetting(place, f"[targets] {name}", "is not the name of a figure", make_remedy(name, known))


def _parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="sim run",
        description="Run a scenario with whole nodes in this process, and check it; Ctrl-C prints the partial result.",
        epilog="Example: sim run --scenario steady --nodes 100 --seed 7.  Exit code: 0: success; 1: a target or an "
        "invariant is missed; 2: the scenario cannot be run; 130: interrupted.",
    )
    parser.add_argument("--scenario", required=True, metavar="NAME", help=f"{', '.join(list_names())}, or a .toml file")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of all random numbers (default 1)")
    parser.add_argument("--nodes", type=int, metavar="N", help="number of nodes (default: that of the scenario)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report to FILE as JSON")
    parser.add_argument("--trace", type=Path, metavar="FILE", help="write the events to FILE, one line of JSON each")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="write the figures over time to FILE as SVG")
    return parser.parse_args(arguments)


def _open_file(path: Path | None, key: str, files: ExitStack) -> TextIO | None:
    if path is None:
        return None
    try:
        return files.enter_context(path.open("w", encoding="utf-8"))
    except OSError as error:
        problem = f"cannot write {path}: {error.strerror or error}"
        raise BadSetting("command line", key, problem, "choose a file in an existing folder") from error
