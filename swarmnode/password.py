"""``swarm password``: print the hash of a password for ``[web] password``; the password is not stored."""

from __future__ import annotations

import argparse
import getpass
import os
import sys
from collections.abc import Callable, Sequence
from typing import TextIO

from webnode.password import MAX_LENGTH, MIN_LENGTH, SALT_BYTES, hash_password


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    about = "Ask for a password, and print its hash for the setting [web] password."
    return argparse.ArgumentParser(prog="swarm password", description=about, epilog="Example: swarm password")


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    ask: Callable[[str], str] = getpass.getpass,
    salt: Callable[[int], bytes] = os.urandom,
) -> int:
    """Run the command; returns 0, or 1 if there is no valid password."""
    out = out or sys.stdout
    make_parser().parse_args(words)
    try:
        password = ask("Password: ")
        problem = ""
        if not MIN_LENGTH <= len(password) <= MAX_LENGTH:
            problem = f"the password has {len(password)} characters; a password must have {MIN_LENGTH} to {MAX_LENGTH}"
        elif password != password.strip() or not password.isprintable():
            problem = "the password begins or ends with a space, or has an unprintable character; choose another"
        elif ask("Repeat the password: ") != password:
            problem = "the passwords are not the same; try again"
    except (EOFError, KeyboardInterrupt):
        problem = "no password entered"
    if problem:
        sys.stderr.write(f"swarm password: {problem}\n")
        return 1
    out.write(f'password = "{hash_password(password, salt(SALT_BYTES))}"\n')
    return 0
