"""``swarm web``: show the pages of the nodes on this machine, with their sign-in codes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import TextIO

from middleware.entangled.control.conversion import remove_control_characters
from middleware.entangled.control.socket_path import NoControl
from swarmnode.page_access import PageAccess, list_pages


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    web = argparse.ArgumentParser(
        prog="swarm web",
        description="Show the address of the page of each node on this machine, and the code to sign in.",
        epilog="Example: swarm web --node vaio",
    )
    web.add_argument("--node", metavar="NAME", help="show only the page of this node")
    web.add_argument("--json", action="store_true", help="print JSON, one line per page")
    return web


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    known: Callable[[], list[PageAccess]] = list_pages,
) -> int:
    """Run the command; returns 0, or 2 if no node with a page runs here."""
    out = out or sys.stdout
    options = make_parser().parse_args(words)
    try:
        here = known()
    except NoControl as problem:
        sys.stderr.write(remove_control_characters(f"swarm web: {problem}") + "\n")
        return 2
    found = [each for each in here if options.node in (None, each.name)]
    if not found:
        names = ", ".join(each.name for each in here)
        remedy = f"nodes with a page: {names}" if here else "start a node with the role web"
        which = "no node" if options.node is None else f"no node {options.node!r}"
        sys.stderr.write(
            remove_control_characters(f"swarm web: {which} with a page runs on this machine; {remedy}; ")
            + "see docs/explanation/access-and-robot-safety.md\n"
        )
        return 2
    for each in found:
        if options.json:
            out.write(json.dumps(asdict(each) | {"link": each.link}) + "\n")
        else:
            code = f"code {each.code}, or open {each.link}" if each.code else "no sign-in: anyone may control the team"
            also = f" and {each.secure}" if each.secure else ""
            out.write(remove_control_characters(f"{each.name}: {each.url}{also}  {code}") + "\n")
    return 0
