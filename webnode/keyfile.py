"""Read and write a private key file that only the node's user can access."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

MAX_FILE_BYTES = 64 * 1024


class UnsafeFile(Exception):
    """The file exists and must not be used; the message says why."""


def read_key_file(path: Path) -> bytes | None:
    """Read the file, None if it does not exist; raises ``UnsafeFile`` if other users could have read or written it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UnsafeFile(f"the file cannot be read ({error.strerror})") from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise UnsafeFile("the path is not a regular file")
        if status.st_uid not in (os.geteuid(), 0):
            raise UnsafeFile("the file belongs to another user")
        if status.st_mode & 0o077:
            raise UnsafeFile(f"other users can read or write the file (mode {stat.S_IMODE(status.st_mode):o})")
        return os.read(descriptor, MAX_FILE_BYTES)
    finally:
        os.close(descriptor)


def write_key_file(path: Path, content: bytes) -> None:
    """Write ``content`` atomically, readable by the node's user only; raises ``OSError``."""
    fresh = path.with_name(f"{path.name}.new")
    with suppress(FileNotFoundError):
        fresh.unlink()
    with open(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
