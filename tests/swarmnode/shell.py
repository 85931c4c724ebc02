"""Run ``swarm`` verbs against a node of a simulated team in virtual time."""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.request_handler import RequestHandler
from middleware.entangled.control.socket_path import prepare_path
from middleware.node import SwarmNode
from swarmnode.simulated_team import SimulatedTeam
from swarmnode.team.verb import TeamVerbs

Main = Callable[..., int]
PATIENCE = 5.0


def runtime_folder(case: SynchronousTestCase, node: str = "vaio") -> Path:
    """Create a folder in which commands find the control socket of ``node``, until the test ends.

    The folders of Trial have paths that are too long for a socket.
    """
    folder = Path(tempfile.mkdtemp())
    case.addCleanup(shutil.rmtree, folder)
    case.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(folder)})
    prepare_path(node).touch()
    return folder


class Shell:
    """Runs commands on the machine of ``node``; the wait for a reply is limited to ``PATIENCE`` virtual seconds."""

    def __init__(self, team: SimulatedTeam, node: SwarmNode) -> None:
        self._team = team
        self._verbs = TeamVerbs(RequestHandler.create(node.entangled, team.clock, random.Random(1)), node)
        self.said = ""

    def ask(self, path: Path, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Return the reply of the node, like the control socket."""
        answers: list[dict[str, Any]] = []
        work = self._verbs.run(request["verb"], request["with"], lambda event: None)
        work.addCallbacks(
            lambda answer: answers.append({"answer": answer}),
            lambda failure: answers.append({"error": failure.type.__name__, "text": failure.getErrorMessage()}),
        )
        waited = 0.0
        while not answers and waited < PATIENCE:
            self._team.clock.advance(0.05)
            waited += 0.05
        yield from answers

    def run(self, main: Main, words: Sequence[str]) -> tuple[int, str]:
        """Run a command; return exit code and output, and store the error output in ``said``."""
        output, complaint = io.StringIO(), io.StringIO()
        with contextlib.redirect_stderr(complaint):
            code = main(list(words), output, self.ask)
        self.said = complaint.getvalue()
        return code, output.getvalue()
