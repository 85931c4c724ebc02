"""Files with secrets: readable by their owner only, and replaced atomically."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from middleware.admission.errors import BadKeyFile

FILE_MODE = 0o600
MAX_FILE_BYTES = 2**20


def read(path: Path) -> dict[str, Any]:
    """Return the mapping in the file at ``path``; raise ``BadKeyFile``, also if other users can read the file."""
    content = read_bytes(path)
    try:
        found = json.loads(content)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or len(content) > MAX_FILE_BYTES:
        raise BadKeyFile(f"{path} is damaged; restore it from a backup, or have it created again")
    return found


def read_bytes(path: Path) -> bytes:
    """Return the content of ``path``, at most ``MAX_FILE_BYTES`` + 1 bytes; raises ``BadKeyFile`` as ``read`` does."""
    try:
        with open(path, "rb") as file:
            state = os.fstat(file.fileno())
            if not stat.S_ISREG(state.st_mode):
                raise BadKeyFile(f"{path} is not a regular file; use the path of the file itself")
            if state.st_mode & 0o077:
                mode = stat.S_IMODE(state.st_mode)
                raise BadKeyFile(
                    f"{path} holds secrets, and other users can read or change it (mode {mode:04o}); "
                    f"run chmod 600 {path}, and replace the key if another user may have read it"
                )
            return file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise BadKeyFile(f"{path} cannot be read: {error.strerror or error}; check the path") from error


def write(path: Path, content: Mapping[str, Any], is_new: bool = False) -> None:
    """Replace the file at ``path`` with ``content``, or create it if ``is_new``; raises ``BadKeyFile``.

    A concurrent read, or a read after a power failure, returns either the old or the new content.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    if is_new and path.exists():
        raise BadKeyFile(f"{path} is there already; remove it if it is no longer needed, or name another file")
    try:
        with suppress(FileNotFoundError):
            fresh.unlink()
        with open(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, FILE_MODE), "w") as file:
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
