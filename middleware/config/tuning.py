"""Settings that can be changed while the node runs; changes are stored in the node's store.

The device checks each change by the rules of the settings file.  The file is never written; stored changes override it
at each start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import msgpack

from formats.convert import Invalid, convert_field, nearest_of
from middleware.config.settings import NodeSettings, Settings
from middleware.directory.presence import Capabilities
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.value import MAX_VALUE
from middleware.node import SwarmNode

SETTINGS, TUNE = "device.settings", "device.tune"
WRONG = "setting"
"""Code of a refusal with the text ``KEY: problem; remedy``."""
NOTE = "tuning"


@dataclass(frozen=True)
class Knob:
    """One changeable setting: ``check`` converts a value or raises ``Invalid``; ``turn`` applies it.

    ``least`` and ``most`` are the bounds of a number, or of the length of a text, for display.
    """

    key: str
    about: str
    read: Callable[[], Any]
    turn: Callable[[Any], None]
    check: Callable[[Any], Any]
    unit: str = ""
    least: float | None = None
    most: float | None = None


class Tuning:
    """The changeable settings of one node; changes are kept in ``store``."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._knobs: dict[str, Knob] = {}
        self._stored = _load_stored(store)

    def add(self, knob: Knob) -> None:
        """Add a setting, and apply its stored value."""
        self._knobs[knob.key] = knob
        if knob.key in self._stored:
            with suppress(Invalid):  # valid when it was stored; otherwise the file's value applies
                knob.turn(knob.check(self._stored[knob.key]))

    def told(self) -> list[list[object]]:
        """Return each setting as ``[key, value, about, unit, least, most]``."""
        return [[k.key, k.read(), k.about, k.unit, k.least, k.most] for k in self._knobs.values()]

    def change(self, changes: Mapping[Any, Any]) -> list[list[object]]:
        """Apply all changes or none; raises ``Refused`` with the code ``WRONG``."""
        checked = {key: self._check_change(key, value) for key, value in changes.items()}
        before = {key: self._knobs[key].read() for key in checked}
        for key, value in checked.items():
            try:
                self._knobs[key].turn(value)
            except Invalid as wrong:
                for other, old in before.items():
                    self._knobs[other].turn(old)
                raise _make_refusal(key, wrong) from None
        self._stored.update(changes)
        self._store.note(NOTE, bytes(msgpack.packb(self._stored)))
        return self.told()

    def _check_change(self, key: object, value: object) -> Any:
        if not isinstance(key, str) or key not in self._knobs:
            remedy = f"the nearest is {nearest_of(str(key), self._knobs)}" if self._knobs else "leave it unchanged"
            raise _make_refusal(key, Invalid("", "cannot be changed on this device", remedy))
        try:
            return self._knobs[key].check(value)
        except Invalid as wrong:
            raise _make_refusal(key, wrong) from None

    def answer_settings(self, peer: Contact) -> list[list[object]]:
        """Answer a request for the settings."""
        return self.told()

    def answer_tune(self, peer: Contact, changes: dict[str, object]) -> list[list[object]]:
        """Answer a request to change settings."""
        return self.change(changes)


def answer_tuning(node: SwarmNode, settings: Settings, body: Capabilities | None = None) -> Tuning:
    """Expose the changeable settings of ``node``; ``body`` are the capabilities of its robot."""
    tuning = Tuning(node.store)

    def check(key: str) -> Callable[[Any], Any]:
        return partial(convert_field, cls=NodeSettings, key=key)

    extra = dict(settings.node.capabilities)

    def describe(text: str) -> None:
        node.presence.change(description=text)

    def enable(capabilities: Capabilities) -> None:
        nonlocal extra
        device = replace(node.presence.device, capabilities={**(body or {}), **capabilities})
        if len(device.packed()) > MAX_VALUE:
            raise Invalid("capabilities", f"makes the device's record larger than {MAX_VALUE} bytes", "leave some out")
        extra = dict(capabilities)
        node.presence.change(capabilities=device.capabilities)

    about = "A line about the device"
    tuning.add(
        Knob("description", about, lambda: node.presence.device.description, describe, check("description"), most=200)
    )
    about = "Time until other nodes consider a silent device lost"
    lease = node.entangled
    tuning.add(
        Knob("presence_lease", about, lambda: lease.lease, lease.set_lease, check("presence_lease"), "s", 0.1, 60.0)
    )
    about = "Capabilities of the device in addition to its driver's"
    tuning.add(Knob("capabilities", about, lambda: extra, enable, check("capabilities")))
    node.entangled.endpoint.expose(SETTINGS, tuning.answer_settings, changes=True, idempotent=True)
    node.entangled.endpoint.expose(TUNE, tuning.answer_tune, changes=True, idempotent=True)
    return tuning


def _make_refusal(key: object, wrong: Invalid) -> Refused:
    return Refused(f"{str(key)[:64]}: {wrong.problem}; {wrong.remedy}", WRONG)


def _load_stored(store: Store) -> dict[str, Any]:
    try:
        kept = msgpack.unpackb(store.noted(NOTE) or b"\x80")
    except Exception:  # damaged file
        return {}
    return kept if isinstance(kept, dict) else {}
