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

from middleware.consensus.verdict import verdict_of, verdicts_text
from middleware.diagnostics.explanation import as_text, explained
from middleware.entangled.control.command import FAILED, WRONG, Ask, asked
from middleware.entangled.control.place import NoControl
from middleware.entangled.control.word import printable
from middleware.tasks.task import Task, outcome_of, tasks_of
from swarmnode.asker import Asker, Refusal

LAST = "last"
LISTED = 5


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    why = argparse.ArgumentParser(
        prog="swarm why",
        description="Explain the choice of a device for a task.",
        epilog="Example: swarm why last",
    )
    why.add_argument("task", metavar="TASK", help=f"beginning of a task's id, or {LAST!r} for the newest task")
    why.add_argument("--node", metavar="NAME", help="node on this machine, if several run")
    why.add_argument("--json", action="store_true", help="print JSON, on one line")
    return why


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: Ask = asked) -> int:
    """Run the command; returns 0, 1 if there is no decision or the node refused, 2 if no node can be asked."""
    out = out or sys.stdout
    options = parser().parse_args(words)
    try:
        asker = Asker(options.node, ask)
        task = chosen(options.task, list(tasks_of(asker.records("tasks")).values()))
        outcome = outcome_of(task, asker.records(f"task/{task.task_id}"))
        records = asker.records(verdicts_text(task.task_id))
    except (Refusal, NoControl) as problem:
        sys.stderr.write(printable(f"swarm why: {problem}") + "\n")
        return FAILED if isinstance(problem, Refusal) else WRONG
    verdicts = [verdict for each in records if (verdict := verdict_of(each)) is not None]
    explanation = explained(verdict for verdict in verdicts if verdict.task == task.task_id)
    if options.json:
        head_fields = {"task": task.task_id, "title": task.title, "strategy": task.strategy}
        ended = None if outcome is None else {"outcome": outcome.outcome, "by": outcome.by, "took": outcome.took}
        out.write(json.dumps({**head_fields, "outcome": ended, "epochs": asdict(explanation)["epochs"]}) + "\n")
        return 0 if explanation.epochs else FAILED
    ended_by = "" if outcome is None else f", {outcome.outcome.lower()} by {outcome.by}"
    head = printable(f"task {task.task_id}: {task.title}{ended_by}")
    out.write(f"{head}\n{as_text(explanation)}")
    if not explanation.epochs:
        out.write("no decision yet\n")
    return 0 if explanation.epochs else FAILED


def chosen(wanted: str, tasks: Sequence[Task]) -> Task:
    """Return the task with the id prefix ``wanted``, or the newest for ``last``; raises ``Refusal`` with candidates."""
    newest = {task.task_id: task for task in tasks}
    known = sorted(tasks, key=lambda task: (-task.created, task.task_id))
    if not known:
        raise Refusal("the team has no task; assign one on the page of its web node")
    if wanted == LAST:
        return known[0]
    matching = [task for task in known if task.task_id.startswith(wanted)] if wanted else []
    if len(matching) == 1 or (wanted in newest):
        return newest[wanted] if wanted in newest else matching[0]
    near = ", ".join(task.task_id for task in (matching or known)[:LISTED])
    if matching:
        raise Refusal(f"{len(matching)} tasks begin with {wanted!r}: {near}; give more of the id")
    raise Refusal(f"no task begins with {wanted!r}; the newest are {near}")
