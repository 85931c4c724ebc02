"""Keyfile: a file with a private key in it, which nobody but the node's user may read."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

MOST = 64 * 1024


class Unsafe(Exception):
    """The file is there and must not be used; the message says why."""


def kept(path: Path) -> bytes | None:
    """What the file holds, None where there is none; raises ``Unsafe`` where others could have read or put it there."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise Unsafe(f"it cannot be read ({error.strerror})") from error
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise Unsafe("it is no plain file")
        if about.st_uid not in (os.geteuid(), 0):
            raise Unsafe("it belongs to another user")
        if about.st_mode & 0o077:
            raise Unsafe(f"others may read or write it (mode {stat.S_IMODE(about.st_mode):o})")
        return os.read(descriptor, MOST)
    finally:
        os.close(descriptor)


def keep(path: Path, content: bytes) -> None:
    """Put ``content`` there, for the node's user alone, as a whole or not at all; raises ``OSError``."""
    fresh = path.with_name(f"{path.name}.new")
    with suppress(FileNotFoundError):
        fresh.unlink()
    with open(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
