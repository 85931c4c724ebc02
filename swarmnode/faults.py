"""``swarm chaos``: inject faults into a running team, and measure the time of the takeover."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TextIO

from middleware.directory.presence import Device
from middleware.entangled.control.command import FAILED, WRONG, Ask, asked
from middleware.entangled.control.place import NoControl
from middleware.entangled.control.word import printable
from middleware.errors import BadFault, BadSetting
from middleware.faults.kinds import ASKED, ASSIGN, CAUSE, KINDS, MAX_S, MIN_S, USUAL_S, Fault, begins_in, parse_fault
from middleware.faults.play import NobodyThere, play
from middleware.faults.scenario import Scenario, Step, loaded
from middleware.tasks.task import outcome_of, tasks_of
from swarmnode.asker import Asker, Refusal

RUN, LIST = "run", "list"


class TeamStage:
    """A running team, accessed through the control socket of a node on this machine."""

    def __init__(self, asker: Asker, seconds: Callable[[], float], wait: Callable[[float], None]) -> None:
        self.seconds = seconds
        self.wait = wait
        self._asker = asker

    def devices(self) -> list[Device]:
        """Return the present devices."""
        return [device for device, _ in self._asker.devices()]

    def assign(self, task: str) -> str:
        """Publish a task through the first device that permits it."""
        refusals = []
        for device in self.devices():
            try:
                return str(self._asker.call(device.address, ASSIGN, task))
            except Refusal as error:
                refusals.append(f"{device.name}: {error}")
        raise Refusal("no device publishes the task: " + ("; ".join(refusals) or "no device is present"))

    def cause(self, device: Device, fault: Fault) -> float:
        """Order the fault at the device."""
        try:
            return begins_in(self._asker.call(device.address, CAUSE, fault.kind, fault.seconds, fault.amount or None))
        except Refusal as error:
            raise Refusal(f"{device.name}: {_explain(error)}") from error

    def is_over(self, task_id: str) -> bool:
        """Return whether the outcome of the task is recorded."""
        task = tasks_of(self._asker.records("tasks", "fast")).get(task_id)
        return task is not None and outcome_of(task, self._asker.records(f"task/{task_id}", "fast")) is not None

    def suffers(self, device: Device) -> str:
        """Describe the faults that the device supports, and the active ones."""
        try:
            answer = self._asker.call(device.address, ASKED)
        except Refusal as error:
            return _explain(error)
        active = "; ".join(f"{kind} for another {max(0.0, left):.0f} s" for kind, left, _ in answer["active"])
        return ", ".join(map(str, answer["kinds"])) + (f" (now: {active})" if active else "")


def _explain(error: Refusal) -> str:
    # Replace the error for an unknown method by an explanation.
    is_unknown = "method" in str(error)
    return 'it does not allow faults; set "allow = true" in [faults] of its settings' if is_unknown else str(error)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line for one fault."""
    kinds = "\n".join(f"  {name:9}{kind.about}" for name, kind in KINDS.items())
    chaos = argparse.ArgumentParser(
        prog="swarm chaos",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Inject a fault into a device, and measure the time until another device takes over its task.",
        epilog=f"kinds:\n{kinds}\n\nswarm chaos list: list the faults that each device supports.\n"
        "swarm chaos run FILE: run a scenario; see swarm chaos run --help.\n\n"
        "example: swarm chaos executing radio --seconds 10",
    )
    chaos.add_argument("device", metavar="DEVICE", help='name of the device, "executing" or "any"')
    chaos.add_argument("kind", metavar="KIND", help="kind of fault")
    chaos.add_argument(
        "--seconds", type=float, default=USUAL_S, help=f"duration, {MIN_S:g} to {MAX_S:g} s (default: {USUAL_S:g})"
    )
    chaos.add_argument("--amount", type=float, help="amount of delay, loss, skew or battery")
    _common(chaos)
    return chaos


def scenario_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line for a scenario."""
    run = argparse.ArgumentParser(
        prog="swarm chaos run",
        description="Run a scenario: faults and their times from a file.",
        epilog="Example: swarm chaos run examples/scenarios/takeover.toml --rehearse --seed 7",
    )
    run.add_argument("file", metavar="FILE", type=Path, help="scenario, such as examples/scenarios/takeover.toml")
    run.add_argument("--rehearse", action="store_true", help="run it with a simulated team; a seed repeats a run")
    _common(run)
    return run


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, help='selects the devices for "any" (default: the seed of the scenario)')
    parser.add_argument("--node", metavar="NAME", help="node on this machine, if several run")


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    ask: Ask = asked,
    seconds: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> int:
    """Run the command; returns 0, 1 if a takeover was late or a device refused, 2 if the command is wrong."""
    out = out or sys.stdout
    arguments = list(sys.argv[1:] if words is None else words)

    def say(text: str) -> None:
        out.write(printable(text) + "\n")
        out.flush()

    try:
        if arguments[:1] == [RUN]:
            options = scenario_parser().parse_args(arguments[1:])
            scenario = loaded(options.file)
            if options.rehearse:
                return _rehearse(scenario, options.seed, say)
        elif arguments[:1] == [LIST]:
            listing = argparse.ArgumentParser(
                prog="swarm chaos list",
                description="List the faults that each device supports, and the active ones.",
                epilog="Example: swarm chaos list --node dog1",
            )
            _common(listing)
            stage = TeamStage(Asker(listing.parse_args(arguments[1:]).node, ask), seconds, wait)
            for device in stage.devices():
                say(f"{device.name:12}{stage.suffers(device)}")
            return 0
        else:
            options = parser().parse_args(arguments)
            fault = parse_fault(options.kind, options.seconds, options.amount)
            scenario = Scenario("", (Step(0.0, options.device, fault),))
        stage = TeamStage(Asker(options.node, ask), seconds, wait)
        losses = play(scenario, scenario.seed if options.seed is None else options.seed, stage, say)
    except (BadFault, BadSetting, NoControl) as problem:
        sys.stderr.write(printable(f"swarm chaos: {problem}") + "\n")
        return WRONG
    except (Refusal, NobodyThere) as problem:
        sys.stderr.write(printable(f"swarm chaos: {problem}") + "\n")
        return FAILED
    except KeyboardInterrupt:
        return FAILED
    return 0 if all(loss.held for loss in losses) else FAILED


def _rehearse(scenario: Scenario, seed: int | None, say: Callable[[str], None]) -> int:
    from swarmnode.rehearsal import RehearsedStage  # imported on demand: it needs the simulator's libraries

    seed = scenario.seed if seed is None else seed
    stage = RehearsedStage(seed)
    try:
        losses = play(scenario, seed, stage, say)
    finally:
        stage.stop()
    say(f"digest {stage.digest()}")
    return 0 if all(loss.held for loss in losses) else FAILED
