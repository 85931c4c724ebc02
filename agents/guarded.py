"""Guarded: a behaviour in another process, which may raise, hang or end without harm to the agent.

The agent never waits: each call asks, and returns the last answer if it is fresh and belongs to the same method and
lease.  Else the body stands.  Once the behaviour has failed it is asked no more: the body stands, and there
is no cost to report, so that another goes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import astuple
from typing import Any, Protocol

from twisted.logger import Logger

from agents.context import Context
from agents.means import Means
from agents.pushed import (
    EMBODY,
    EXECUTE,
    HOLD,
    LOOK,
    OPTIONAL,
    SEARCH,
    plain_means,
    plain_observation,
)
from drivers.reading import Action, Observation

FRESH_S = 0.3
"""Seconds for which an action counts after the moment that it was asked for."""
MAX_KEYS = 64
MAX_KEY = 64
ACT = "act"


class Conversation(Protocol):
    """The way to the behaviour; ``middleware.deployment.runner.Instance`` is one."""

    fault: str
    facts: dict[str, Any]

    @property
    def is_behind(self) -> bool:
        """Whether not all that was sent has arrived."""

    def ask(self, method: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> bool:
        """Ask without waiting; whether it could be asked."""

    def look(self) -> None:
        """Take in the answers."""

    def close(self) -> None:
        """End it."""


class Guarded:
    """The behaviour behind ``inner`` while it does not fail, and ``stand`` from then on."""

    _log = Logger()

    def __init__(self, inner: Conversation, stand: Action) -> None:
        self._inner = inner
        self._stand = stand
        self._has_failed = False
        self._cost: object = None
        self._told: dict[str, object] = dict(OPTIONAL)
        self._asking: set[str] = set()
        self._means: Means | None = None
        self._sent_means: dict[str, Any] = {}
        self._found: tuple[tuple[str, int], float, Action | None] | None = None
        self._knows_facts = False

    @property
    def has_failed(self) -> bool:
        """Whether it is asked no more."""
        self._look()
        return self._has_failed

    def embody(self, means: Means) -> None:
        """Tell it the means of its body; changes of them are told before each look."""
        self._means = means
        self._send_means()

    def look(self, seen: Observation, now: float) -> None:
        """Take in an observation; left out while the previous look is unanswered."""
        self._look()
        self._send_means()
        if not self._inner.is_behind:
            self._ask(LOOK, LOOK, [plain_observation(seen), now], lambda result: None)

    @property
    def cost(self) -> float | None:
        """The cost of the task for this body; None if it cannot tell, or has failed."""
        self._look()
        cost = self._cost
        is_lawful = isinstance(cost, int | float) and not isinstance(cost, bool) and 0 <= cost < float("inf")
        return cost if is_lawful and not self._has_failed else None  # type: ignore[return-value]

    def search(self, now: float) -> Action:
        """What to do to be able to tell."""
        return self._motion(SEARCH, now)

    def hold(self, now: float) -> Action:
        """What to do while another acts."""
        return self._motion(HOLD, now)

    def execute(self, context: Context) -> Action | None:
        """What to do next to get it done; None when it is done."""
        return self._act(EXECUTE, context.token, context.now, list(astuple(context)))

    def close(self) -> None:
        """End it: its agent has left the task."""
        self._has_failed = True
        self._inner.close()

    def __getattr__(self, name: str) -> object:
        """An optional attribute; ``AttributeError`` for anything else."""
        if name not in OPTIONAL:
            raise AttributeError(name)
        self._look()
        return OPTIONAL[name] if self._has_failed else self._told[name]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _motion(self, method: str, now: float) -> Action:
        action = self._act(method, 0, now, [now])
        return self._stand if action is None else action

    def _act(self, method: str, token: int, now: float, arguments: list[Any]) -> Action | None:
        kind = method, token

        def take(result: object) -> None:
            self._found = kind, now, _action(result)

        self._ask(ACT, method, arguments, take)
        self._look()
        if self._has_failed or self._found is None:
            return self._stand
        of, asked_at, action = self._found
        return action if of == kind and 0.0 <= now - asked_at <= FRESH_S else self._stand

    def _send_means(self) -> None:
        if self._means is None:
            return
        fields = plain_means(self._means)
        if fields != self._sent_means and self._ask(EMBODY, EMBODY, [fields], lambda result: None):
            self._sent_means = fields

    def _ask(self, about: str, method: str, arguments: list[Any], take: Callable[[object], None]) -> bool:
        """Ask, unless it is still asked about that; whether it was asked."""
        if self._has_failed or about in self._asking:
            return False

        def answered(is_well: bool, content: Any) -> None:
            self._asking.discard(about)
            if not is_well:
                return self._fail(str(content))
            try:
                result, told = content
                self._learn(told)
                take(result)
            except (TypeError, ValueError) as error:
                self._fail(f"its answer is none: {error}")

        self._asking.add(about)
        if not self._inner.ask(method, arguments, answered):
            self._asking.discard(about)
            return False
        return True

    def _look(self) -> None:
        if self._has_failed:
            return
        self._inner.look()
        if not self._knows_facts and "told" in self._inner.facts:
            self._knows_facts = True
            try:
                self._learn(self._inner.facts["told"])
            except (TypeError, ValueError) as error:
                self._fail(f"its answer is none: {error}")
        if self._inner.fault:
            self._fail(self._inner.fault)

    def _learn(self, told: Any) -> None:
        self._knows_facts = True
        self._cost, *others = told
        for (name, usual), value in zip(OPTIONAL.items(), others, strict=True):
            self._told[name] = tuple(value) if isinstance(usual, tuple) and isinstance(value, list) else value

    def _fail(self, why: str) -> None:
        if not self._has_failed:
            self._has_failed = True
            self._log.error("a deployed behaviour failed, and the body stands from now on: {why}", why=why)
            self._inner.close()


def _action(result: object) -> Action | None:
    """An action that may go on to the driver, or None for the end of the task; raises ``ValueError``."""
    if result is None:
        return None
    if not isinstance(result, Mapping) or len(result) > MAX_KEYS:
        raise ValueError("an action is a mapping of a few keys")
    for key, value in result.items():
        if not isinstance(key, str) or len(key) > MAX_KEY or type(value) is not float or not math.isfinite(value):
            raise ValueError("an action gives a finite number to each key")
    return result
