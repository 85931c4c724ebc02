"""MemoryStore: the data store that lives as long as the program."""

from __future__ import annotations

from middleware.entangled.data.store import Store


class MemoryStore(Store):
    """A store without a file: what it holds is gone with the process."""
