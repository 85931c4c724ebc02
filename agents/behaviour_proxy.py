"""A behaviour in a separate process: if the behaviour raises, hangs or exits, the agent continues to work.

Calls do not block: each call sends a request and returns the last result, provided that it is recent and from the same
method and lease. Otherwise the robot stands still. After a failure the behaviour is not called again: the robot stands
still and the agent reports no cost, so another agent acts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import astuple
from typing import Any, Protocol

from twisted.logger import Logger

from agents.behaviour_process import (
    EMBODY,
    EXECUTE,
    HOLD,
    LOOK,
    OPTIONAL_ATTRIBUTES,
    SEARCH,
    encode_motion,
    encode_observation,
)
from agents.context import Context
from agents.motion import MotionCapabilities
from drivers.reading import Action, Observation

ACTION_TTL_S = 0.3
"""Seconds for which an action is valid after its request."""
MAX_KEYS = 64
MAX_KEY_CHARS = 64
ACT = "act"


class BehaviourConnection(Protocol):
    """The connection to the behaviour's process, as in ``middleware.deployment.runner.BehaviourInstance``."""

    fault: str
    facts: dict[str, Any]

    @property
    def has_unsent(self) -> bool:
        """Whether some of the sent data has not been transmitted yet."""

    def send_request(self, method: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> bool:
        """Send a request without waiting for its result; returns whether it was sent."""

    def poll(self) -> None:
        """Process the received results."""

    def close(self) -> None:
        """Close the connection."""


class BehaviourProxy:
    """Performs the behaviour of the process behind ``inner``; after a failure it always returns ``stand``."""

    _log = Logger()

    def __init__(self, inner: BehaviourConnection, stand: Action) -> None:
        self._connection = inner
        self._stand = stand
        self._has_failed = False
        self._cost: object = None
        self._attributes: dict[str, object] = dict(OPTIONAL_ATTRIBUTES)
        self._pending: set[str] = set()
        self._motion: MotionCapabilities | None = None
        self._sent_motion: dict[str, Any] = {}
        self._last_action: tuple[tuple[str, int], float, Action | None] | None = None
        self._has_attributes = False

    @property
    def has_failed(self) -> bool:
        """Whether the behaviour has failed, so it is no longer called."""
        self._receive()
        return self._has_failed

    def embody(self, motion: MotionCapabilities) -> None:
        """Pass on the robot's motion capabilities; later changes to them are sent before each observation."""
        self._motion = motion
        self._send_motion()

    def look(self, seen: Observation, now: float) -> None:
        """Pass on an observation; skipped while the previous one is unanswered."""
        self._receive()
        self._send_motion()
        if not self._connection.has_unsent:
            self._send(LOOK, LOOK, [encode_observation(seen), now], lambda result: None)

    @property
    def cost(self) -> float | None:
        """The cost of the task for this robot; None if the cost is unknown or the behaviour has failed."""
        self._receive()
        cost = self._cost
        is_valid = isinstance(cost, int | float) and not isinstance(cost, bool) and 0 <= cost < float("inf")
        return cost if is_valid and not self._has_failed else None  # type: ignore[return-value]

    def search(self, now: float) -> Action:
        """Return the next action while the cost is unknown."""
        return self._motion_or_stand(SEARCH, now)

    def hold(self, now: float) -> Action:
        """Return the next action while another robot acts."""
        return self._motion_or_stand(HOLD, now)

    def execute(self, context: Context) -> Action | None:
        """Return the next action of the task; None if the task is done."""
        return self._act(EXECUTE, context.token, context.now, list(astuple(context)))

    def close(self) -> None:
        """Close the connection, after the agent has left the task."""
        self._has_failed = True
        self._connection.close()

    def __getattr__(self, name: str) -> object:
        """Return an optional attribute; raise ``AttributeError`` for any other."""
        if name not in OPTIONAL_ATTRIBUTES:
            raise AttributeError(name)
        self._receive()
        return OPTIONAL_ATTRIBUTES[name] if self._has_failed else self._attributes[name]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _motion_or_stand(self, method: str, now: float) -> Action:
        action = self._act(method, 0, now, [now])
        return self._stand if action is None else action

    def _act(self, method: str, token: int, now: float, arguments: list[Any]) -> Action | None:
        kind = method, token

        def take(result: object) -> None:
            self._last_action = kind, now, _check_action(result)

        self._send(ACT, method, arguments, take)
        self._receive()
        if self._has_failed or self._last_action is None:
            return self._stand
        of, asked_at, action = self._last_action
        return action if of == kind and 0.0 <= now - asked_at <= ACTION_TTL_S else self._stand

    def _send_motion(self) -> None:
        if self._motion is None:
            return
        fields = encode_motion(self._motion)
        if fields != self._sent_motion and self._send(EMBODY, EMBODY, [fields], lambda result: None):
            self._sent_motion = fields

    def _send(self, about: str, method: str, arguments: list[Any], take: Callable[[object], None]) -> bool:
        """Send a request unless one of the same kind is pending; returns whether it was sent."""
        if self._has_failed or about in self._pending:
            return False

        def answered(is_ok: bool, content: Any) -> None:
            self._pending.discard(about)
            if not is_ok:
                return self._fail(str(content))
            try:
                result, attributes = content
                self._set_attributes(attributes)
                take(result)
            except (TypeError, ValueError) as error:
                self._fail(f"invalid result: {error}")

        self._pending.add(about)
        if not self._connection.send_request(method, arguments, answered):
            self._pending.discard(about)
            return False
        return True

    def _receive(self) -> None:
        if self._has_failed:
            return
        self._connection.poll()
        if not self._has_attributes and "told" in self._connection.facts:
            self._has_attributes = True
            try:
                self._set_attributes(self._connection.facts["told"])
            except (TypeError, ValueError) as error:
                self._fail(f"invalid result: {error}")
        if self._connection.fault:
            self._fail(self._connection.fault)

    def _set_attributes(self, attributes: Any) -> None:
        self._has_attributes = True
        self._cost, *others = attributes
        for (name, default), value in zip(OPTIONAL_ATTRIBUTES.items(), others, strict=True):
            self._attributes[name] = tuple(value) if isinstance(default, tuple) and isinstance(value, list) else value

    def _fail(self, why: str) -> None:
        if not self._has_failed:
            self._has_failed = True
            self._log.error("a deployed behaviour failed; the robot stands still from now on: {why}", why=why)
            self._connection.close()


def _check_action(result: object) -> Action | None:
    """Return a valid action for the driver, or None at the end of the task; raises ``ValueError``."""
    if result is None:
        return None
    if not isinstance(result, Mapping) or len(result) > MAX_KEYS:
        raise ValueError(f"an action must be a mapping with at most {MAX_KEYS} keys")
    for key, value in result.items():
        if not isinstance(key, str) or len(key) > MAX_KEY_CHARS or type(value) is not float or not math.isfinite(value):
            raise ValueError(
                f"each key of an action must have at most {MAX_KEY_CHARS} characters, each value must be a finite float"
            )
    return result
