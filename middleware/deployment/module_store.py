"""Storage of accepted modules: one file for each module, written atomically."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

SUFFIX, UNFINISHED_SUFFIX = ".module", ".unfinished"


class ModuleStore(Protocol):
    """The interface of module storage; names are file names without the suffix."""

    def save(self, name: str, content: bytes) -> None:
        """Store ``content`` under ``name``; raise ``OSError`` with the old content unchanged."""

    def list_modules(self) -> list[tuple[str, bytes]]:
        """Return all readable modules, sorted by name."""

    def delete(self, name: str) -> None:
        """Delete ``name``; never raises."""


class MemoryModuleStore:
    """Module storage in memory."""

    def __init__(self) -> None:
        self.contents: dict[str, bytes] = {}

    def save(self, name: str, content: bytes) -> None:
        """Store ``content`` under ``name``."""
        self.contents[name] = content

    def list_modules(self) -> list[tuple[str, bytes]]:
        """Return all stored modules."""
        return sorted(self.contents.items())

    def delete(self, name: str) -> None:
        """Delete ``name``."""
        self.contents.pop(name, None)


class FileModuleStore:
    """Module storage in a folder, created at the first ``save`` with access for its owner only.

    A file is written under a temporary name, synced to disk, and then renamed, so after a power failure either the old
    or the new file exists.  ``move`` is ``os.replace``.
    """

    def __init__(self, folder: Path, move: Callable[[Path, Path], object] = os.replace) -> None:
        self._folder = folder
        self._move = move

    def save(self, name: str, content: bytes) -> None:
        """Store ``content`` under ``name``; raises ``OSError``."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        beside = self._folder / f"{name}{UNFINISHED_SUFFIX}"
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        self._move(beside, self._folder / f"{name}{SUFFIX}")
        handle = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

    def list_modules(self) -> list[tuple[str, bytes]]:
        """Return all stored modules, and remove unfinished files."""
        found = []
        for path in sorted(self._folder.glob(f"*{UNFINISHED_SUFFIX}")):
            path.unlink(missing_ok=True)
        for path in sorted(self._folder.glob(f"*{SUFFIX}")):
            try:
                found.append((path.name.removesuffix(SUFFIX), path.read_bytes()))
            except OSError:
                continue
        return found

    def delete(self, name: str) -> None:
        """Delete ``name``."""
        try:
            (self._folder / f"{name}{SUFFIX}").unlink(missing_ok=True)
        except OSError:
            return
