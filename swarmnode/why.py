"""``swarm why TASK``: explain the assignments of a task from the agents' signed decision records.

All data is read under three keys, through the control socket of a node on this machine.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import TextIO

from middleware.consensus.decision_record import decision_records_key_text, parse_decision_record
from middleware.diagnostics.explanation import explain_decisions, format_explanation
from middleware.entangled.control.command import EXIT_FAILED, EXIT_USAGE, SendRequest, send_request
from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.control.socket_path import NoControl
from middleware.tasks.task import Task, find_outcome, parse_tasks
from swarmnode.control_client import ControlClient, Rejection

LAST_TASK = "last"
MAX_LISTED = 5


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    why = argparse.ArgumentParser(
        prog="swarm why",
        description="Explain why a device was assigned to a task, from the agents' signed decision records.",
        epilog="Example: swarm why last",
    )
    why.add_argument("task", metavar="TASK", help=f"beginning of a task's id, or {LAST_TASK!r} for the newest task")
    why.add_argument("--node", metavar="NAME", help="name of the node, if several run on this machine")
    why.add_argument("--json", action="store_true", help="print JSON, on one line")
    return why


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: SendRequest = send_request) -> int:
    """Run the command; returns 0, 1 if there is no decision or the node rejected it, 2 if no node runs here."""
    out = out or sys.stdout
    options = make_parser().parse_args(words)
    try:
        client = ControlClient(options.node, ask)
        task = select_task(options.task, list(parse_tasks(client.get_records("tasks")).values()))
        outcome = find_outcome(task, client.get_records(f"task/{task.task_id}"))
        records = client.get_records(decision_records_key_text(task.task_id))
    except (Rejection, NoControl) as problem:
        sys.stderr.write(remove_control_characters(f"swarm why: {problem}") + "\n")
        return EXIT_FAILED if isinstance(problem, Rejection) else EXIT_USAGE
    decisions = [record for each in records if (record := parse_decision_record(each)) is not None]
    explanation = explain_decisions(record for record in decisions if record.task == task.task_id)
    if options.json:
        head_fields = {"task": task.task_id, "title": task.title, "strategy": task.strategy}
        ended = None if outcome is None else {"outcome": outcome.outcome, "by": outcome.by, "took": outcome.took}
        out.write(json.dumps({**head_fields, "outcome": ended, "epochs": asdict(explanation)["epochs"]}) + "\n")
        return 0 if explanation.epochs else EXIT_FAILED
    ended_by = "" if outcome is None else f", {outcome.outcome.lower()} by {outcome.by}"
    head = remove_control_characters(f"task {task.task_id}: {task.title}{ended_by}")
    out.write(f"{head}\n{format_explanation(explanation)}")
    if not explanation.epochs:
        out.write("no decision yet\n")
    return 0 if explanation.epochs else EXIT_FAILED


def select_task(wanted: str, tasks: Sequence[Task]) -> Task:
    """Return the task with the id prefix ``wanted``, or the newest for ``last``; raises ``Rejection``."""
    newest = {task.task_id: task for task in tasks}
    known = sorted(tasks, key=lambda task: (-task.created, task.task_id))
    if not known:
        raise Rejection("the team has no task; assign one on the page of its web node")
    if wanted == LAST_TASK:
        return known[0]
    matching = [task for task in known if task.task_id.startswith(wanted)] if wanted else []
    if len(matching) == 1 or (wanted in newest):
        return newest[wanted] if wanted in newest else matching[0]
    near = ", ".join(task.task_id for task in (matching or known)[:MAX_LISTED])
    if matching:
        raise Rejection(f"{len(matching)} task ids begin with {wanted!r}: {near}; enter more characters")
    raise Rejection(f"no task id begins with {wanted!r}; the newest are {near}")
