"""``swarm faults``: inject faults into a running team, and measure the time of the takeover."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TextIO

from middleware.directory.presence import Device
from middleware.entangled.control.command import EXIT_FAILED, EXIT_USAGE, SendRequest, send_request
from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.control.socket_path import NoControl
from middleware.errors import BadFault, BadSetting
from middleware.faults.kinds import (
    ASSIGN_METHOD,
    CAUSE_METHOD,
    DEFAULT_S,
    KINDS,
    LIST_METHOD,
    MAX_S,
    MIN_S,
    Fault,
    parse_delay,
    parse_fault,
)
from middleware.faults.scenario import Scenario, Step, load_scenario
from middleware.faults.scenario_runner import DeviceNotPresent, run_scenario
from middleware.tasks.task import find_outcome, parse_tasks
from swarmnode.control_client import ControlClient, Rejection

RUN, LIST = "run", "list"


class TeamStage:
    """A running team, accessed through the control socket of a node on this machine."""

    def __init__(self, client: ControlClient, seconds: Callable[[], float], wait: Callable[[float], None]) -> None:
        self.seconds = seconds
        self.wait = wait
        self._client = client

    def devices(self) -> list[Device]:
        """Return the devices that are online."""
        return [device for device, _ in self._client.list_devices()]

    def assign(self, task: str) -> str:
        """Publish a task through the first device that accepts the request; return the id of the task."""
        refusals = []
        for device in self.devices():
            try:
                return str(self._client.call(device.address, ASSIGN_METHOD, task))
            except Rejection as error:
                refusals.append(f"{device.name}: {error}")
        raise Rejection("no device accepts the task: " + ("; ".join(refusals) or "no device is online"))

    def inject(self, device: Device, fault: Fault) -> float:
        """Request the fault from the device; return the delay in seconds until it begins."""
        try:
            return parse_delay(
                self._client.call(device.address, CAUSE_METHOD, fault.kind, fault.seconds, fault.amount or None)
            )
        except Rejection as error:
            raise Rejection(f"{device.name}: {_explain(error)}") from error

    def is_over(self, task_id: str) -> bool:
        """Return whether the outcome of the task is recorded."""
        task = parse_tasks(self._client.get_records("tasks", "fast")).get(task_id)
        return task is not None and find_outcome(task, self._client.get_records(f"task/{task_id}", "fast")) is not None

    def describe_faults(self, device: Device) -> str:
        """Describe the faults that the device supports, and its active faults."""
        try:
            answer = self._client.call(device.address, LIST_METHOD)
        except Rejection as error:
            return _explain(error)
        active = "; ".join(f"{kind} for another {max(0.0, left):.0f} s" for kind, left, _ in answer["active"])
        return ", ".join(map(str, answer["kinds"])) + (f" (now: {active})" if active else "")


def _explain(error: Rejection) -> str:
    # Replace the error for an unknown method by an explanation.
    is_unknown = "method" in str(error)
    return 'fault injection is off; set "allow = true" in [faults] of its settings' if is_unknown else str(error)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line for one fault."""
    kinds = "\n".join(f"  {name:9}{kind.about}" for name, kind in KINDS.items())
    chaos = argparse.ArgumentParser(
        prog="swarm faults",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Inject a fault into a device, and measure the time until another device takes over its task.",
        epilog=f"kinds:\n{kinds}\n\nswarm faults list: list the faults that each device supports.\n"
        "swarm faults run FILE: run a scenario; see swarm faults run --help.\n\n"
        "example: swarm faults executing radio --seconds 10",
    )
    chaos.add_argument("device", metavar="DEVICE", help='name, "executing" (a device that acts on a task) or "any"')
    chaos.add_argument("kind", metavar="KIND", help="kind of fault")
    chaos.add_argument(
        "--seconds", type=float, default=DEFAULT_S, help=f"duration, {MIN_S:g} to {MAX_S:g} s (default: {DEFAULT_S:g})"
    )
    chaos.add_argument("--amount", type=float, help="amount, for the kinds delay, loss, skew and battery")
    _add_common_arguments(chaos)
    return chaos


def make_scenario_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line for a scenario."""
    run = argparse.ArgumentParser(
        prog="swarm faults run",
        description="Run a scenario: a file that lists faults and their times.",
        epilog="Example: swarm faults run examples/scenarios/takeover.toml --rehearse --seed 7",
    )
    run.add_argument("file", metavar="FILE", type=Path, help="scenario, such as examples/scenarios/takeover.toml")
    run.add_argument("--rehearse", action="store_true", help="use a simulated team; equal seeds give equal runs")
    _add_common_arguments(run)
    return run


def _add_common_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, help='seed for the choice of "any" device (default: that of the scenario)')
    parser.add_argument("--node", metavar="NAME", help="name of the node, if several run on this machine")


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    ask: SendRequest = send_request,
    seconds: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> int:
    """Run the command; returns 0, 1 if a takeover was late or a device rejected a fault, 2 if the command is wrong."""
    out = out or sys.stdout
    arguments = list(sys.argv[1:] if words is None else words)

    def say(text: str) -> None:
        out.write(remove_control_characters(text) + "\n")
        out.flush()

    try:
        if arguments[:1] == [RUN]:
            options = make_scenario_parser().parse_args(arguments[1:])
            scenario = load_scenario(options.file)
            if options.rehearse:
                return _run_simulated(scenario, options.seed, say)
        elif arguments[:1] == [LIST]:
            listing = argparse.ArgumentParser(
                prog="swarm faults list",
                description="List the faults that each device supports, and its active faults.",
                epilog="Example: swarm faults list --node dog1",
            )
            _add_common_arguments(listing)
            stage = TeamStage(ControlClient(listing.parse_args(arguments[1:]).node, ask), seconds, wait)
            for device in stage.devices():
                say(f"{device.name:12}{stage.describe_faults(device)}")
            return 0
        else:
            options = make_parser().parse_args(arguments)
            fault = parse_fault(options.kind, options.seconds, options.amount)
            scenario = Scenario("", (Step(0.0, options.device, fault),))
        stage = TeamStage(ControlClient(options.node, ask), seconds, wait)
        losses = run_scenario(scenario, scenario.seed if options.seed is None else options.seed, stage, say)
    except (BadFault, BadSetting, NoControl) as problem:
        sys.stderr.write(remove_control_characters(f"swarm faults: {problem}") + "\n")
        return EXIT_USAGE
    except (Rejection, DeviceNotPresent) as problem:
        sys.stderr.write(remove_control_characters(f"swarm faults: {problem}") + "\n")
        return EXIT_FAILED
    except KeyboardInterrupt:
        return EXIT_FAILED
    return 0 if all(loss.is_within_target for loss in losses) else EXIT_FAILED


def _run_simulated(scenario: Scenario, seed: int | None, say: Callable[[str], None]) -> int:
    from swarmnode.simulated_team import SimulatedStage  # imported on demand: it needs the simulator's libraries

    seed = scenario.seed if seed is None else seed
    stage = SimulatedStage(seed)
    try:
        losses = run_scenario(scenario, seed, stage, say)
    finally:
        stage.stop()
    say(f"digest {stage.digest()}")
    return 0 if all(loss.is_within_target for loss in losses) else EXIT_FAILED
