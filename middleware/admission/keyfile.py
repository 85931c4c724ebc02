"""Keyfile: a small file with secrets, for the eyes of its owner alone, and replaced whole or not at all."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from middleware.admission.errors import BadKeyFile

MODE = 0o600
MAX_FILE = 2**20


def read(path: Path) -> dict[str, Any]:
    """The mapping that the file at ``path`` holds; raises ``BadKeyFile``, also where others can read it."""
    content = read_bytes(path)
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or len(content) > MAX_FILE:
        raise BadKeyFile(f"{path} is not what it should be; take it from a backup, or have it made again")
    return found


def read_bytes(path: Path) -> bytes:
    """The bytes of the file at ``path``, at most one more than ``MAX_FILE``; raises ``BadKeyFile`` as ``read`` does."""
    try:
        with open(path, "rb") as file:
            state = os.fstat(file.fileno())
            if not stat.S_ISREG(state.st_mode):
                raise BadKeyFile(f"{path} is no file; name the file itself")
            if state.st_mode & 0o077:
                mode = stat.S_IMODE(state.st_mode)
                raise BadKeyFile(
                    f"{path} holds secrets and can be read or changed by others (mode {mode:04o}); "
                    f"say chmod 600 {path}, and have the key replaced if somebody may have read it"
                )
            return file.read(MAX_FILE + 1)
    except OSError as error:
        raise BadKeyFile(f"{path} cannot be read: {error.strerror or error}; name the right file") from error


def write(path: Path, content: Mapping[str, Any], is_new: bool = False) -> None:
    """Put ``content`` in the place of the file at ``path``, or make it where ``is_new``; raises ``BadKeyFile``.

    Whoever reads meanwhile, or after a loss of power, finds the old content or the new one whole.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    if is_new and path.exists():
        raise BadKeyFile(f"{path} is there already; remove it first if nobody needs it any more, or name another file")
    try:
        with suppress(FileNotFoundError):
            fresh.unlink()
        with open(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, MODE), "w") as file:
            json.dump(content, file, indent=1)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        with suppress(OSError):
            fresh.unlink()
        raise BadKeyFile(f"{path} cannot be written: {error.strerror or error}") from error
