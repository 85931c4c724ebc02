"""Why: ``swarm why TASK``, the decisions of a task explained from the agents' signed verdicts.

Whatever it tells it reads under three keys, through the control socket of a node of this machine.
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
    """The command line."""
    why = argparse.ArgumentParser(prog="swarm why", description="Explain who was chosen for a task, and why.")
    why.add_argument("task", metavar="TASK", help=f"the beginning of a task's id, or {LAST!r} for the newest")
    why.add_argument("--node", metavar="NAME", help="which node of this machine, where several run")
    why.add_argument("--json", action="store_true", help="answer in JSON, on one line")
    return why


def main(words: Sequence[str] | None = None, out: TextIO | None = None, ask: Ask = asked) -> int:
    """Run the command; returns 0, 1 where there is nothing to tell or the node refused, 2 where nobody can be asked."""
    out = out or sys.stdout
    wishes = parser().parse_args(words)
    try:
        asker = Asker(wishes.node, ask)
        task = chosen(wishes.task, list(tasks_of(asker.records("tasks")).values()))
        outcome = outcome_of(task, asker.records(f"task/{task.task_id}"))
        records = asker.records(verdicts_text(task.task_id))
    except (Refusal, NoControl) as problem:
        sys.stderr.write(printable(f"swarm why: {problem}") + "\n")
        return FAILED if isinstance(problem, Refusal) else WRONG
    verdicts = [verdict for each in records if (verdict := verdict_of(each)) is not None]
    explanation = explained(verdict for verdict in verdicts if verdict.task == task.task_id)
    if wishes.json:
        told = {"task": task.task_id, "title": task.title, "strategy": task.strategy}
        ended = None if outcome is None else {"outcome": outcome.outcome, "by": outcome.by, "took": outcome.took}
        out.write(json.dumps({**told, "outcome": ended, "epochs": asdict(explanation)["epochs"]}) + "\n")
        return 0 if explanation.epochs else FAILED
    ended_by = "" if outcome is None else f", {outcome.outcome.lower()} by {outcome.by}"
    head = printable(f"task {task.task_id}: {task.title}{ended_by}")
    out.write(f"{head}\n{as_text(explanation)}")
    if not explanation.epochs:
        out.write("nobody has decided anything yet\n")
    return 0 if explanation.epochs else FAILED


def chosen(wanted: str, tasks: Sequence[Task]) -> Task:
    """The task whose id begins with ``wanted``, or the newest for ``last``; raises ``Refusal`` with those near."""
    newest = {task.task_id: task for task in tasks}
    known = sorted(tasks, key=lambda task: (-task.created, task.task_id))
    if not known:
        raise Refusal("the team has no task; assign one on the page of its web node")
    if wanted == LAST:
        return known[0]
    meant = [task for task in known if task.task_id.startswith(wanted)] if wanted else []
    if len(meant) == 1 or (wanted in newest):
        return newest[wanted] if wanted in newest else meant[0]
    near = ", ".join(task.task_id for task in (meant or known)[:LISTED])
    if meant:
        raise Refusal(f"{len(meant)} tasks begin with {wanted!r}: {near}; say more of the id")
    raise Refusal(f"no task begins with {wanted!r}; the newest are {near}")
