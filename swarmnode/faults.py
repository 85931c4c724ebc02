"""``swarm chaos``: inject faults into a running team, and measure how soon another device takes over."""

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
    """A running team, through the control socket of a node of this machine."""

    def __init__(self, asker: Asker, seconds: Callable[[], float], wait: Callable[[float], None]) -> None:
        self.seconds = seconds
        self.wait = wait
        self._asker = asker

    def devices(self) -> list[Device]:
        """Who is there."""
        return [device for device, _ in self._asker.devices()]

    def assign(self, task: str) -> str:
        """Publish a task, through the first device that lets us."""
        refusals = []
        for device in self.devices():
            try:
                return str(self._asker.call(device.address, ASSIGN, task))
            except Refusal as error:
                refusals.append(f"{device.name}: {error}")
        raise Refusal("nobody publishes the task: " + ("; ".join(refusals) or "no device is there"))

    def cause(self, device: Device, fault: Fault) -> float:
        """Ask the device."""
        try:
            return begins_in(self._asker.call(device.address, CAUSE, fault.kind, fault.seconds, fault.amount or None))
        except Refusal as error:
            raise Refusal(f"{device.name}: {_plain(error)}") from error

    def is_over(self, task_id: str) -> bool:
        """Whether its outcome is recorded."""
        task = tasks_of(self._asker.records("tasks", "fast")).get(task_id)
        return task is not None and outcome_of(task, self._asker.records(f"task/{task_id}", "fast")) is not None

    def suffers(self, device: Device) -> str:
        """What it can suffer, and what it suffers, in words."""
        try:
            told = self._asker.call(device.address, ASKED)
        except Refusal as error:
            return _plain(error)
        active = "; ".join(f"{kind} for another {max(0.0, left):.0f} s" for kind, left, _ in told["active"])
        return ", ".join(map(str, told["kinds"])) + (f" (now: {active})" if active else "")


def _plain(error: Refusal) -> str:
    # What a node without the method answers says nothing to a person.
    is_unknown = "method" in str(error)
    return 'it allows no faults; write "allow = true" below [faults] of its settings' if is_unknown else str(error)


def parser() -> argparse.ArgumentParser:
    """The command line of one fault."""
    kinds = "\n".join(f"  {name:9}{kind.about}" for name, kind in KINDS.items())
    chaos = argparse.ArgumentParser(
        prog="swarm chaos",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Let a device fail on purpose, and time how soon another takes over its task.",
        epilog=f"kinds:\n{kinds}\n\nswarm chaos list: what each device can suffer.\n"
        "swarm chaos run FILE: a scenario; swarm chaos run --help says more.",
    )
    chaos.add_argument("device", metavar="DEVICE", help='its name, or "executing" for who acts, or "any"')
    chaos.add_argument("kind", metavar="KIND", help="what it suffers")
    chaos.add_argument(
        "--seconds", type=float, default=USUAL_S, help=f"{MIN_S:g} to {MAX_S:g}; {USUAL_S:g} if not said"
    )
    chaos.add_argument("--amount", type=float, help="how much, for delay, loss, skew and battery")
    _common(chaos)
    return chaos


def scenario_parser() -> argparse.ArgumentParser:
    """The command line of a scenario."""
    run = argparse.ArgumentParser(prog="swarm chaos run", description="Carry out a scenario: faults out of a file.")
    run.add_argument("file", metavar="FILE", type=Path, help="such as examples/scenarios/takeover.toml")
    run.add_argument("--rehearse", action="store_true", help="in memory, with three dogs: a seed gives the same run")
    _common(run)
    return run


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, help='who "any" is; the scenario\'s own if not said')
    parser.add_argument("--node", metavar="NAME", help="which node of this machine is asked, where several run")


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    ask: Ask = asked,
    seconds: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> int:
    """Run the command; returns 0, 1 where a takeover was late or a device refused, 2 where the command is wrong."""
    out = out or sys.stdout
    given = list(sys.argv[1:] if words is None else words)

    def say(text: str) -> None:
        out.write(printable(text) + "\n")
        out.flush()

    try:
        if given[:1] == [RUN]:
            wishes = scenario_parser().parse_args(given[1:])
            scenario = loaded(wishes.file)
            if wishes.rehearse:
                return _rehearse(scenario, wishes.seed, say)
        elif given[:1] == [LIST]:
            listing = argparse.ArgumentParser(prog="swarm chaos list", description="What each device can suffer.")
            _common(listing)
            stage = TeamStage(Asker(listing.parse_args(given[1:]).node, ask), seconds, wait)
            for device in stage.devices():
                say(f"{device.name:12}{stage.suffers(device)}")
            return 0
        else:
            wishes = parser().parse_args(given)
            fault = parse_fault(wishes.kind, wishes.seconds, wishes.amount)
            scenario = Scenario("", (Step(0.0, wishes.device, fault),))
        stage = TeamStage(Asker(wishes.node, ask), seconds, wait)
        losses = play(scenario, scenario.seed if wishes.seed is None else wishes.seed, stage, say)
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
    from swarmnode.rehearsal import RehearsedStage  # the yard's libraries are for this alone

    seed = scenario.seed if seed is None else seed
    stage = RehearsedStage(seed)
    try:
        losses = play(scenario, seed, stage, say)
    finally:
        stage.stop()
    say(f"digest {stage.digest()}")
    return 0 if all(loss.held for loss in losses) else FAILED
