"""Call a behaviour in this process with the same plain values that another process would receive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from agents.behaviour_process import BehaviourKind
from middleware.consensus.deployed_modules import Factory
from middleware.deployment import module_channel


class Loopback:
    """A conversation with a behaviour; replies arrive immediately, or on ``let`` while ``is_held`` is set."""

    def __init__(self, make: Factory, parameters: Mapping[str, Any] | None = None) -> None:
        self.fault = ""
        self.facts: dict[str, Any] = {}
        self.has_unsent = False
        self.is_held = False
        self.is_closed = False
        self.asked: list[str] = []
        self._kind = BehaviourKind()
        self._thing = self._kind.make(make, [dict(parameters or {}), 1])
        self.facts = self._kind.describe_instance(self._thing)
        self._held: list[Callable[[], None]] = []

    @classmethod
    def of(cls, make: Factory) -> Callable[..., Loopback]:
        """Return a factory of conversations with behaviours that ``make`` creates."""
        return lambda parameters, rng: cls(make, parameters)

    def send_request(self, method: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> bool:
        """Call ``method`` of the behaviour and pass the result to ``take``."""
        if self.fault:
            return False
        self.asked.append(method)
        number, _, carried = module_channel.parse_request(module_channel.pack([1, method, arguments])[4:])
        try:
            content = self._kind.call(self._thing, method, carried)
            answer = module_channel.parse_reply(module_channel.pack([number, True, content])[4:])[1:]
        except Exception as error:  # the process of a deployed behaviour also replies with the error
            answer = False, f"{type(error).__name__}: {error}"
        self._held.append(lambda: take(*answer))
        if not self.is_held:
            self.let()
        return True

    def let(self) -> None:
        """Deliver the results that are held back."""
        held, self._held = self._held, []
        for each in held:
            each()

    def poll(self) -> None:
        """Do nothing: replies arrive only during calls."""

    def close(self) -> None:
        """Record that the conversation is closed."""
        self.is_closed = True
