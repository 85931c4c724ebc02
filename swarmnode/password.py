"""Password: ``swarm password``, the hash of a password for ``[web] password``; it stores nothing."""

from __future__ import annotations

import argparse
import getpass
import os
import sys
from collections.abc import Callable, Sequence
from typing import TextIO

from webnode.password import LEAST, MOST, SALT, hashed


def parser() -> argparse.ArgumentParser:
    """The command line."""
    about = "Ask for a password, and print its hash, to be put into the settings as [web] password."
    return argparse.ArgumentParser(prog="swarm password", description=about)


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    ask: Callable[[str], str] = getpass.getpass,
    salt: Callable[[int], bytes] = os.urandom,
) -> int:
    """Run the command; returns 0, or 1 where there is no password to hash."""
    out = out or sys.stdout
    parser().parse_args(words)
    try:
        password = ask("Password: ")
        problem = ""
        if not LEAST <= len(password) <= MOST:
            problem = f"it has {len(password)} characters; take {LEAST} to {MOST}"
        elif password != password.strip() or not password.isprintable():
            problem = "it begins or ends with a space, or holds what cannot be typed into a page; take another"
        elif ask("Once more: ") != password:
            problem = "the two are not the same; try again"
    except (EOFError, KeyboardInterrupt):
        problem = "there was none"
    if problem:
        sys.stderr.write(f"swarm password: {problem}\n")
        return 1
    out.write(f'password = "{hashed(password, salt(SALT))}"\n')
    return 0
