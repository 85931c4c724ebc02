"""Tuning: the settings of a node that can be changed while it runs; what was changed is kept in its store.

The device itself checks each change, by the rule of the settings file.  Nothing writes that file: what is kept goes
before it, at each start.
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
"""The code of a refusal whose text is ``KEY: problem; remedy``."""
NOTE = "tuning"


@dataclass(frozen=True)
class Knob:
    """One setting: ``check`` returns what it is to be, or raises ``Invalid``; ``turn`` makes it so.

    ``least`` and ``most`` bound a number, or the characters of a text; both are for people.
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
    """The knobs of one node; what was turned is kept in ``store``."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._knobs: dict[str, Knob] = {}
        self._kept = _kept(store)

    def add(self, knob: Knob) -> None:
        """Have one more knob, and turn it to where it was left in an earlier life."""
        self._knobs[knob.key] = knob
        if knob.key in self._kept:
            with suppress(Invalid):  # it was lawful when it was kept; the file's value holds
                knob.turn(knob.check(self._kept[knob.key]))

    def told(self) -> list[list[object]]:
        """Each knob as ``[key, value, about, unit, least, most]``."""
        return [[k.key, k.read(), k.about, k.unit, k.least, k.most] for k in self._knobs.values()]

    def change(self, changes: Mapping[Any, Any]) -> list[list[object]]:
        """Turn some, all or none; raises ``Refused`` with the code ``WRONG``."""
        checked = {key: self._checked(key, value) for key, value in changes.items()}
        before = {key: self._knobs[key].read() for key in checked}
        for key, value in checked.items():
            try:
                self._knobs[key].turn(value)
            except Invalid as wrong:
                for other, old in before.items():
                    self._knobs[other].turn(old)
                raise _refused(key, wrong) from None
        self._kept.update(changes)
        self._store.note(NOTE, bytes(msgpack.packb(self._kept)))
        return self.told()

    def _checked(self, key: object, value: object) -> Any:
        if not isinstance(key, str) or key not in self._knobs:
            remedy = f"the nearest is {nearest_of(str(key), self._knobs)}" if self._knobs else "let be"
            raise _refused(key, Invalid("", "cannot be changed on this device", remedy))
        try:
            return self._knobs[key].check(value)
        except Invalid as wrong:
            raise _refused(key, wrong) from None

    def answer_settings(self, peer: Contact) -> list[list[object]]:
        """Say what can be changed."""
        return self.told()

    def answer_tune(self, peer: Contact, changes: dict[str, object]) -> list[list[object]]:
        """Change it."""
        return self.change(changes)


def answer_tuning(node: SwarmNode, settings: Settings, body: Capabilities | None = None) -> Tuning:
    """Have ``node`` tell and change what of ``settings`` can be changed; ``body`` is what its robot can do."""
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
    about = "How long the others believe in the device without a sign of it"
    lease = node.entangled
    tuning.add(
        Knob("presence_lease", about, lambda: lease.lease, lease.set_lease, check("presence_lease"), "s", 0.1, 60.0)
    )
    about = "What the device can do beyond what its driver says"
    tuning.add(Knob("capabilities", about, lambda: extra, enable, check("capabilities")))
    node.entangled.endpoint.expose(SETTINGS, tuning.answer_settings, changes=True, idempotent=True)
    node.entangled.endpoint.expose(TUNE, tuning.answer_tune, changes=True, idempotent=True)
    return tuning


def _refused(key: object, wrong: Invalid) -> Refused:
    return Refused(f"{str(key)[:64]}: {wrong.problem}; {wrong.remedy}", WRONG)


def _kept(store: Store) -> dict[str, Any]:
    try:
        kept = msgpack.unpackb(store.noted(NOTE) or b"\x80")
    except Exception:  # a rotten file may hold anything
        return {}
    return kept if isinstance(kept, dict) else {}
