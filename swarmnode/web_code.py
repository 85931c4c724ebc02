"""Web code: ``swarm web``, where the pages of this machine's nodes are, and the code to sign in with."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import TextIO

from middleware.entangled.control.place import NoControl
from middleware.entangled.control.word import printable
from swarmnode.invitation import Invitation, invitations


def parser() -> argparse.ArgumentParser:
    """The command line."""
    web = argparse.ArgumentParser(prog="swarm web", description="Where the page is, and the code to sign in with.")
    web.add_argument("--node", metavar="NAME", help="of which node of this machine, where several have a page")
    web.add_argument("--json", action="store_true", help="answer in JSON, one line a page")
    return web


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    known: Callable[[], list[Invitation]] = invitations,
) -> int:
    """Run the command; returns 0, or 2 where there is no page."""
    out = out or sys.stdout
    wishes = parser().parse_args(words)
    try:
        here = known()
    except NoControl as problem:
        sys.stderr.write(printable(f"swarm web: {problem}") + "\n")
        return 2
    found = [each for each in here if wishes.node in (None, each.name)]
    if not found:
        there = f"there are those of {', '.join(each.name for each in here)}" if here else "start a node with the role"
        whose = "no node with a page" if wishes.node is None else f"no page of a node {wishes.node!r}"
        sys.stderr.write(
            printable(f"swarm web: {whose} runs on this machine; {there}; ")
            + "see docs/explanation/access-and-robot-safety.md\n"
        )
        return 2
    for each in found:
        if wishes.json:
            out.write(json.dumps(asdict(each) | {"link": each.link}) + "\n")
        else:
            code = f"code {each.code}, or open {each.link}" if each.code else "no sign-in; whoever opens it may do all"
            also = f" and {each.secure}" if each.secure else ""
            out.write(printable(f"{each.name}: {each.url}{also}  {code}") + "\n")
    return 0
