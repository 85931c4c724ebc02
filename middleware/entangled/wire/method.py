"""Method: a function that peers may call, with its arguments checked before it runs."""

from __future__ import annotations

import inspect
import math
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field

from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact

_PLAIN = (int, float, bool, str, bytes, list, dict, type(None))


class BadArguments(Refused):
    """The number or the kinds of the arguments do not fit the method."""


@dataclass(frozen=True)
class Method:
    """An exposed function; ``changes`` says that it may run only in an established session, and once per question."""

    name: str
    answer: Callable[..., object]
    changes: bool = False
    _least: int = field(init=False, repr=False)
    _most: float = field(init=False, repr=False)
    _kinds: tuple[tuple[type, ...] | None, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        signature = inspect.signature(self.answer)
        try:
            hints = typing.get_type_hints(self.answer)
        except Exception:  # hints are foreign code too: names imported for type checkers only, partials, callables
            hints = {}
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        parameters = [parameter for parameter in signature.parameters.values() if parameter.kind in positional]
        is_open = any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in signature.parameters.values())
        required = sum(1 for parameter in parameters if parameter.default is inspect.Parameter.empty)
        # The first parameter is the peer.
        object.__setattr__(self, "_least", max(0, required - 1))
        object.__setattr__(self, "_most", math.inf if is_open else len(parameters) - 1)
        object.__setattr__(self, "_kinds", tuple(_kinds(hints.get(parameter.name)) for parameter in parameters[1:]))

    def run(self, peer: Contact, arguments: tuple[object, ...]) -> object:
        """Call the function; raises ``BadArguments`` where they do not fit, or what the function raises."""
        if not self._least <= len(arguments) <= self._most:
            count = f"{self._least}" if self._least == self._most else f"{self._least} to {self._most}"
            raise BadArguments(f"{self.name}: takes {count} arguments, was given {len(arguments)}")
        for place, (kinds, argument) in enumerate(zip(self._kinds, arguments, strict=False), start=1):
            if kinds is not None and type(argument) not in kinds:
                wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
                raise BadArguments(f"{self.name}: argument {place} must be {wanted}, is {type(argument).__name__}")
        return self.answer(peer, *arguments)


def _kinds(hint: object) -> tuple[type, ...] | None:
    """The plain types that a hint admits, or None where it says more than plain types can."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        kinds: list[type] = []
        for part in typing.get_args(hint):
            inner = _kinds(part)
            if inner is None:
                return None
            kinds += inner
        return tuple(kinds)
    plain = origin or hint
    if plain is float:
        return (float, int)
    return (plain,) if plain in _PLAIN else None
