"""Shelf: where a node keeps the modules that it accepted, each in one file that is whole or not there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

ENDING, UNFINISHED = ".module", ".unfinished"


class Shelf(Protocol):
    """What every shelf does; names are file names without an ending."""

    def keep(self, name: str, content: bytes) -> None:
        """Have ``content`` under ``name`` from now on; raises ``OSError``, and then what was there still is."""

    def everything(self) -> list[tuple[str, bytes]]:
        """All that is kept, in the order of the names; what cannot be read is left out."""

    def drop(self, name: str) -> None:
        """Keep ``name`` no longer; nothing is raised."""


class MemoryShelf:
    """A shelf that lives as long as the program."""

    def __init__(self) -> None:
        self.contents: dict[str, bytes] = {}

    def keep(self, name: str, content: bytes) -> None:
        """Have ``content`` under ``name`` from now on."""
        self.contents[name] = content

    def everything(self) -> list[tuple[str, bytes]]:
        """All that is kept."""
        return sorted(self.contents.items())

    def drop(self, name: str) -> None:
        """Keep ``name`` no longer."""
        self.contents.pop(name, None)


class FileShelf:
    """A folder, made when first something is kept; for its owner's eyes only.

    A file is written beside its place, forced to the disk, and then moved there: a loss of power leaves the old file
    or the new one.  ``move`` is ``os.replace``.
    """

    def __init__(self, folder: Path, move: Callable[[Path, Path], object] = os.replace) -> None:
        self._folder = folder
        self._move = move

    def keep(self, name: str, content: bytes) -> None:
        """Have ``content`` under ``name`` from now on; raises ``OSError``."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        beside = self._folder / f"{name}{UNFINISHED}"
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        self._move(beside, self._folder / f"{name}{ENDING}")
        handle = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

    def everything(self) -> list[tuple[str, bytes]]:
        """All that is kept; what was never finished is removed."""
        found = []
        for path in sorted(self._folder.glob(f"*{UNFINISHED}")):
            path.unlink(missing_ok=True)
        for path in sorted(self._folder.glob(f"*{ENDING}")):
            try:
                found.append((path.name.removesuffix(ENDING), path.read_bytes()))
            except OSError:
                continue
        return found

    def drop(self, name: str) -> None:
        """Keep ``name`` no longer."""
        try:
            (self._folder / f"{name}{ENDING}").unlink(missing_ok=True)
        except OSError:
            return
