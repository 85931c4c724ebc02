"""Settings that can be changed while the node runs; changes are stored in the node's store.

The device checks each change by the same rules as the settings file.  The settings file itself is never written; at
each start, the stored changes override its values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import msgpack

from formats.convert import InvalidValue, convert_field, find_nearest
from middleware.config.settings import NodeSettings, Settings
from middleware.directory.presence import Capabilities
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.value import MAX_VALUE_BYTES
from middleware.node import SwarmNode

SETTINGS_METHOD, TUNE_METHOD = "device.settings", "device.tune"
INVALID_SETTING = "setting"
"""Code of a refusal with the text ``KEY: problem; remedy``."""
NOTE_NAME = "tuning"


@dataclass(frozen=True)
class TunableSetting:
    """One setting that can be changed while the node runs.

    ``check`` converts a value or raises ``InvalidValue``; ``apply`` applies the converted value.

    ``least`` and ``most`` are the bounds of a number, or of the number of characters of a text, for display.
    """

    key: str
    about: str
    read: Callable[[], Any]
    apply: Callable[[Any], None]
    check: Callable[[Any], Any]
    unit: str = ""
    least: float | None = None
    most: float | None = None


class Tuning:
    """The changeable settings of one node; changes are written to ``store``."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._settings: dict[str, TunableSetting] = {}
        self._stored = _load_stored(store)

    def add(self, setting: TunableSetting) -> None:
        """Add a setting, and apply its stored value."""
        self._settings[setting.key] = setting
        if setting.key in self._stored:
            with suppress(InvalidValue):  # a value that is no longer valid is ignored: the file's value applies
                setting.apply(setting.check(self._stored[setting.key]))

    def list_settings(self) -> list[list[object]]:
        """Return each setting as ``[key, value, about, unit, least, most]``."""
        return [[k.key, k.read(), k.about, k.unit, k.least, k.most] for k in self._settings.values()]

    def change(self, changes: Mapping[Any, Any]) -> list[list[object]]:
        """Apply all changes or none; raise ``Refused`` with the code ``INVALID_SETTING`` if any is invalid."""
        checked = {key: self._check_change(key, value) for key, value in changes.items()}
        before = {key: self._settings[key].read() for key in checked}
        for key, value in checked.items():
            try:
                self._settings[key].apply(value)
            except InvalidValue as wrong:
                for other, old in before.items():
                    self._settings[other].apply(old)
                raise _make_refusal(key, wrong) from None
        self._stored.update(changes)
        self._store.set_note(NOTE_NAME, bytes(msgpack.packb(self._stored)))
        return self.list_settings()

    def _check_change(self, key: object, value: object) -> Any:
        if not isinstance(key, str) or key not in self._settings:
            remedy = (
                f"the nearest is {find_nearest(str(key), self._settings)}" if self._settings else "leave it unchanged"
            )
            raise _make_refusal(key, InvalidValue("", "cannot be changed on this device", remedy))
        try:
            return self._settings[key].check(value)
        except InvalidValue as wrong:
            raise _make_refusal(key, wrong) from None

    def answer_settings(self, peer: Contact) -> list[list[object]]:
        """Answer a request for the settings."""
        return self.list_settings()

    def answer_tune(self, peer: Contact, changes: dict[str, object]) -> list[list[object]]:
        """Answer a request to change settings."""
        return self.change(changes)


def expose_tuning(node: SwarmNode, settings: Settings, body: Capabilities | None = None) -> Tuning:
    """Expose the changeable settings of ``node``; ``body`` contains the capabilities of its robot."""
    tuning = Tuning(node.store)

    def check(key: str) -> Callable[[Any], Any]:
        return partial(convert_field, cls=NodeSettings, key=key)

    extra = dict(settings.node.capabilities)

    def describe(text: str) -> None:
        node.presence.change(description=text)

    def enable(capabilities: Capabilities) -> None:
        nonlocal extra
        device = replace(node.presence.device, capabilities={**(body or {}), **capabilities})
        if len(device.pack()) > MAX_VALUE_BYTES:
            raise InvalidValue(
                "capabilities", f"makes the device's record larger than {MAX_VALUE_BYTES} bytes", "leave some out"
            )
        extra = dict(capabilities)
        node.presence.change(capabilities=device.capabilities)

    about = "A line about the device"
    tuning.add(
        TunableSetting(
            "description", about, lambda: node.presence.device.description, describe, check("description"), most=200
        )
    )
    about = "Time until other nodes consider a silent device lost"
    lease = node.entangled
    tuning.add(
        TunableSetting(
            "presence_lease", about, lambda: lease.lease, lease.set_lease, check("presence_lease"), "s", 0.1, 60.0
        )
    )
    about = "Capabilities of the device in addition to its driver's"
    tuning.add(TunableSetting("capabilities", about, lambda: extra, enable, check("capabilities")))
    node.entangled.endpoint.expose(SETTINGS_METHOD, tuning.answer_settings, changes=True, idempotent=True)
    node.entangled.endpoint.expose(TUNE_METHOD, tuning.answer_tune, changes=True, idempotent=True)
    return tuning


def _make_refusal(key: object, wrong: InvalidValue) -> Refused:
    return Refused(f"{str(key)[:64]}: {wrong.problem}; {wrong.remedy}", INVALID_SETTING)


def _load_stored(store: Store) -> dict[str, Any]:
    try:
        stored = msgpack.unpackb(store.get_note(NOTE_NAME) or b"\x80")
    except Exception:  # damaged file
        return {}
    return stored if isinstance(stored, dict) else {}
