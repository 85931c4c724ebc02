"""Run a scenario of faults on a team, and measure the time of each takeover.

The team is a running team (``swarm faults``) or a simulated team in virtual time; the steps are the same for both kinds
of team.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from middleware.directory.presence import Device
from middleware.faults.kinds import KINDS, Fault
from middleware.faults.scenario import ANY_DEVICE, EXECUTING_DEVICE, Scenario
from middleware.faults.takeover import TARGET_S, Takeover, find_executing

POLL_INTERVAL_S = 0.05
DEVICE_TIMEOUT_S = 60.0
"""Seconds to wait for an executing device, or for the device with a given name."""
SETTLE_S = 6.0
"""A takeover is awaited for this number of seconds after a fault; meanwhile, the remaining devices may also end the
task."""
ROLES_WITHOUT_ROBOT = {"bootstrap", "web"}


class DeviceNotPresent(Exception):
    """The device that should get a fault is not present; ``str()`` is one line for display."""


class TeamUnderTest(Protocol):
    """A team for fault scenarios, with its clock."""

    def seconds(self) -> float:
        """Return the time in seconds."""

    def wait(self, seconds: float) -> None:
        """Wait for ``seconds``."""

    def devices(self) -> list[Device]:
        """Return the present devices, in the order of joining."""

    def assign(self, task: str) -> str:
        """Publish a predefined task, and return its id."""

    def inject(self, device: Device, fault: Fault) -> float:
        """Inject the fault; when the device has confirmed, return the seconds until the fault begins."""

    def is_over(self, task_id: str) -> bool:
        """Return whether the task has ended."""


@dataclass
class FaultOutcome:
    """One fault of a device, and the takeover after it; ``is_ended``: the task ended before a takeover."""

    device: str
    fault: Fault
    takeover: Takeover
    to: str = ""
    is_ended: bool = False

    @property
    def is_lost(self) -> bool:
        """Whether a device with this fault cannot continue its task."""
        return KINDS[self.fault.kind].is_lost

    @property
    def is_within_target(self) -> bool:
        """Whether another device took over in time, or no takeover was necessary."""
        if self.takeover.seconds is not None:
            return self.takeover.seconds <= TARGET_S
        must = self.is_lost and self.fault.seconds > TARGET_S
        return not (self.takeover.task and must) or self.is_ended

    def __str__(self) -> str:
        what = f"{self.device}: {self.fault.kind}"
        if not self.takeover.task:
            return f"{what}, executed no task"
        if self.takeover.seconds is not None:
            late = "" if self.is_within_target else f", later than {TARGET_S:g} s"
            return f"{what}, {self.to} took over {self.takeover.task} after {self.takeover.seconds:.2f} s{late}"
        if self.is_ended:
            return f"{what}, {self.takeover.task} ended before another took over"
        return (
            f"{what}, no device took over {self.takeover.task}"
            if not self.is_within_target
            else f"{what}, no takeover needed"
        )


def run_scenario(scenario: Scenario, seed: int, team: TeamUnderTest, say: Callable[[str], None]) -> list[FaultOutcome]:
    """Run the scenario, and report the outcome of each fault as soon as it is known; raise ``DeviceNotPresent``."""
    rng = random.Random(seed)
    losses: list[FaultOutcome] = []
    if scenario.task:
        say(f"assigned {scenario.task} as {team.assign(scenario.task)}")
    began = team.seconds()
    for step in scenario.steps:
        while team.seconds() < began + step.at:
            _update(team, losses, say)
        device = _wait_for_device(team, step.device, rng, losses, say)
        task = find_executing(team.devices()).get(device.uuid, "")
        now = team.inject(device, step.fault) + team.seconds()
        lasts = "" if step.fault.kind == "kill" else f" for {step.fault.seconds:g} s"
        say(f"{device.name}: {step.fault.kind}{lasts}")
        losses.append(FaultOutcome(device.name, step.fault, Takeover(device.uuid, task, now, now + step.fault.seconds)))
    while any(_is_open(loss, team.seconds()) for loss in losses):
        _update(team, losses, say)
    for loss in losses:
        if loss.takeover.seconds is None:
            loss.is_ended = bool(loss.takeover.task) and team.is_over(loss.takeover.task)
            say(str(loss))
    return losses


def _is_open(loss: FaultOutcome, now: float) -> bool:
    return loss.takeover.is_open(now) and (loss.is_lost or now < loss.takeover.until) and not _is_given_up(loss, now)


def _is_given_up(loss: FaultOutcome, now: float) -> bool:
    # The fault of a killed process never ends, and the end of a long fault is not awaited.
    return now > loss.takeover.began + max(SETTLE_S, min(loss.fault.seconds, 3 * SETTLE_S))


def _update(team: TeamUnderTest, losses: Iterable[FaultOutcome], say: Callable[[str], None]) -> None:
    team.wait(POLL_INTERVAL_S)
    devices = team.devices()
    acts, names = find_executing(devices), {device.uuid: device.name for device in devices}
    for loss in losses:
        if loss.takeover.observe(acts, team.seconds()):
            loss.to = names[loss.takeover.to]
            say(str(loss))


def _wait_for_device(
    team: TeamUnderTest, wanted: str, rng: random.Random, losses: Iterable[FaultOutcome], say: Callable[[str], None]
) -> Device:
    end = team.seconds() + DEVICE_TIMEOUT_S
    while team.seconds() <= end:
        if found := _matching_devices(team, wanted, losses):
            return rng.choice(found) if wanted == ANY_DEVICE else found[0]
        _update(team, losses, say)
    names = ", ".join(device.name for device in team.devices()) or "none"
    what = (
        "executes a task"
        if wanted == EXECUTING_DEVICE
        else "can be chosen"
        if wanted == ANY_DEVICE
        else f"has the name {wanted}"
    )
    raise DeviceNotPresent(f"no device {what} within {DEVICE_TIMEOUT_S:g} s; present devices: {names}")


def _matching_devices(team: TeamUnderTest, wanted: str, losses: Iterable[FaultOutcome]) -> list[Device]:
    present = team.devices()
    if wanted == ANY_DEVICE:
        return sorted(
            (each for each in present if not ROLES_WITHOUT_ROBOT & set(each.roles)), key=lambda device: device.name
        )
    if wanted != EXECUTING_DEVICE:
        return [device for device in present if device.name == wanted]
    # Skip an isolated device: its last presence record still says that it executes the task.
    lost = {loss.takeover.lost for loss in losses if loss.is_lost and team.seconds() < loss.takeover.until}
    acts = find_executing(present)
    return [device for device in present if device.uuid in acts and device.uuid not in lost]
