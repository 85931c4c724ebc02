"""A data store in memory."""

from __future__ import annotations

from middleware.entangled.data.store import Store


class MemoryStore(Store):
    """A store without a file; its contents are lost when the process ends."""
