"""A node of libtorrent's DHT with immutable items (BEP 44: the key is the hash of the value).

All nodes share one address here, which the library forbids by default. Its two restrictions of nodes per address and
its flood blocker are therefore always off; otherwise the nodes could not form a network.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from typing import Any

import libtorrent

from benchmarks.dht.aio import AsyncioPeer
from benchmarks.dht.library import HOST, OnDone, OnValue


class LibtorrentPeer(AsyncioPeer):
    """A node of libtorrent; "free" removes the default limit of 8,000 bytes per second for the DHT."""

    def __init__(self, folder: str, limits: str = "") -> None:
        super().__init__(folder)
        self._settings: dict[str, Any] = {
            "enable_dht": True,
            "enable_lsd": False,
            "enable_upnp": False,
            "enable_natpmp": False,
            "dht_bootstrap_nodes": "",
            "dht_restrict_routing_ips": False,
            "dht_restrict_search_ips": False,
            "dht_block_ratelimit": 1_000_000,
            "alert_queue_size": 100_000,
            "alert_mask": int(libtorrent.alert.category_t.dht_notification),
        }
        if limits == "free":
            self._settings["dht_upload_rate_limit"] = 1 << 30
        self._puts: dict[bytes, list[OnDone]] = {}
        self._gets: dict[bytes, list[OnValue]] = {}
        self._joined: Callable[[], None] | None = None

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Open a session and wait until it reports the DHT as started (the first node reports nothing)."""
        self._joined = done
        self._settings["listen_interfaces"] = f"{HOST}:{port}"
        if known:
            self._settings["dht_bootstrap_nodes"] = f"{HOST}:{known}"
        self._session = libtorrent.session(self._settings)
        threading.Thread(target=self._poll_alerts, daemon=True).start()
        if not known:
            self.call_later(1.0, self._report_joined)

    def put(self, key: str, value: bytes, done: OnDone) -> None:
        """Store."""
        self._puts.setdefault(_target(value), []).append(done)
        self._session.dht_put_immutable_item(value)

    def get(self, key: str, value: bytes, done: OnValue) -> None:
        """Read; always from the network."""
        target = _target(value)
        self._gets.setdefault(target, []).append(done)
        self._session.dht_get_immutable_item(libtorrent.sha1_hash(target))

    def list_held(self, keys: list[str]) -> list[bool | None]:
        """Return False for all keys: reads are never answered from this node's store."""
        return [False] * len(keys)

    def _report_joined(self) -> None:
        joined, self._joined = self._joined, None
        if joined is not None:
            joined()

    def _poll_alerts(self) -> None:
        while True:
            if self._session.wait_for_alert(1000):
                for alert in self._session.pop_alerts():
                    if isinstance(alert, libtorrent.dht_put_alert):
                        self.call_soon(self._handle_put, alert.target.to_bytes(), alert.num_success > 0)
                    elif isinstance(alert, libtorrent.dht_immutable_item_alert):
                        self.call_soon(self._handle_item, alert.target.to_bytes(), alert.item)
                    elif isinstance(alert, libtorrent.dht_bootstrap_alert):
                        self.call_soon(self._report_joined)

    def _handle_put(self, target: bytes, is_stored: bool) -> None:
        for done in self._puts.pop(target, []):
            done(is_stored)

    def _handle_item(self, target: bytes, item: object) -> None:
        value = item.encode("latin-1") if isinstance(item, str) else item if isinstance(item, bytes) else None
        for done in self._gets.pop(target, []):
            done(value)


def _target(value: bytes) -> bytes:
    return hashlib.sha1(b"%d:%b" % (len(value), value)).digest()
