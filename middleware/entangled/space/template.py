"""Tuples and templates: their valid fields, and matching; without I/O.

A tuple is a sequence of at most ``MAX_FIELDS`` values.  A template matches tuples with the same number of fields.  Each
field of a template is a value, ``ANY``, a type (``int``, ``float``, ``str``, ``bytes``, ``bool``) or a predicate made
by ``where``.  Types are strict: ``1``, ``1.0`` and ``True`` are three different values; only predicates that compare
numbers treat ``int`` and ``float`` alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import ge, gt, le, lt
from typing import Any, Final, TypeGuard

import msgpack

from middleware.entangled.errors import LocalError, Malformed, TooLarge

Value = None | bool | int | float | str | bytes
Tuple = tuple[Value, ...]

MAX_FIELDS = 32
MAX_TUPLE_BYTES = 600
"""The maximum bytes of a tuple or template in msgpack; the record of a tuple also needs space for the council."""
MAX_CHOICES = 32
OPERATORS = ("<", "<=", ">", ">=", "!=", "in", "prefix")
_COMPARISONS: Final[dict[str, Callable[[Any, Any], bool]]] = {"<": lt, "<=": le, ">": gt, ">=": ge}
_TYPES: Final = (bool, bytes, float, int, str)


class BadTuple(LocalError):
    """A field of a tuple or template is invalid; the message contains the field and lists what is permitted."""


@dataclass(frozen=True)
class Wildcard:
    """A template field that matches any value; ``ANY`` is its only instance."""


ANY: Final = Wildcard()


@dataclass(frozen=True)
class Predicate:
    """A test of one field, made by ``where``."""

    operator: str
    operand: Value | Tuple

    def holds(self, value: Value) -> bool:
        """Return whether ``value`` satisfies the predicate.

        If the type of ``value`` differs from the type of the operand, only ``!=`` is satisfied.
        """
        operand = self.operand
        if isinstance(operand, tuple):
            return any(_are_equal(value, choice) for choice in operand)
        if self.operator == "!=":
            return not (value == operand if _are_numbers(value, operand) else _are_equal(value, operand))
        if self.operator == "prefix":
            if isinstance(value, str) and isinstance(operand, str):
                return value.startswith(operand)
            return isinstance(value, bytes) and isinstance(operand, bytes) and value.startswith(operand)
        is_ordered = _are_numbers(value, operand) or (type(value) is type(operand) and isinstance(value, str | bytes))
        return is_ordered and _COMPARISONS[self.operator](value, operand)


Field = Value | Wildcard | type | Predicate


@dataclass(frozen=True)
class Template:
    """A pattern for tuples, made by ``make_template``."""

    fields: tuple[Field, ...]

    @property
    def arity(self) -> int:
        """The number of fields."""
        return len(self.fields)

    def matches(self, values: Sequence[Value]) -> bool:
        """Return whether the tuple ``values`` matches."""
        return len(values) == len(self.fields) and all(map(_fits, self.fields, values))


def where(operator: str, operand: Value | Sequence[Value]) -> Predicate:
    """Return a predicate for one field: ``where("<", 5)``, ``where("in", ("a", "b"))``, ``where("prefix", "job-")``.

    The operators are ``<  <=  >  >=  !=  in  prefix``.  Raises ``BadTuple`` for other operators and for invalid
    operands.
    """
    if isinstance(operand, Sequence) and not isinstance(operand, str | bytes):
        operand = tuple(operand)
    if operator not in OPERATORS:
        raise BadTuple(f"the operator {operator!r} is unknown; use one of {' '.join(OPERATORS)}")
    if operator == "in":
        if not isinstance(operand, tuple) or len(operand) > MAX_CHOICES or not all(map(is_value, operand)):
            raise BadTuple(f"in: the operand must be a sequence of at most {MAX_CHOICES} values")
    elif not is_value(operand):
        raise BadTuple(
            f"{operator}: {operand!r} is not a valid operand; use None, a bool, int of 64 bits, float, str or bytes"
        )
    elif operator == "prefix" and not isinstance(operand, str | bytes):
        raise BadTuple("prefix: the operand must be a str or bytes")
    elif operator in _COMPARISONS and (operand is None or isinstance(operand, bool)):
        raise BadTuple(f"{operator}: {operand!r} has no order; use an int, float, str or bytes")
    return Predicate(operator, operand)


def make_template(fields: Sequence[Field] | Template) -> Template:
    """Return the template with these fields; raise ``BadTuple`` or ``TooLarge``."""
    if isinstance(fields, Template):
        return fields
    _check_count(fields)
    for place, field in enumerate(fields):
        is_valid = (
            isinstance(field, Wildcard | Predicate) or (isinstance(field, type) and field in _TYPES) or is_value(field)
        )
        if not is_valid:
            raise BadTuple(f"field {place}: {field!r} is not a value, ANY, a type or a predicate")
    _check_size([_pack_field(field) for field in fields])
    return Template(tuple(fields))


def make_tuple(fields: Sequence[Value]) -> Tuple:
    """Return the tuple with these fields; raise ``BadTuple`` or ``TooLarge``."""
    _check_count(fields)
    for place, field in enumerate(fields):
        if not is_value(field):
            raise BadTuple(f"field {place}: {field!r} must be None, a bool, int of 64 bits, float, str or bytes")
    values = tuple(fields)
    _check_size(list(values))
    return values


def is_value(value: object) -> TypeGuard[Value]:
    """Return whether ``value`` may be in a tuple; NaN is invalid, because it is not equal to any value."""
    if value is None or isinstance(value, bool):
        return True
    if type(value) is int:
        return -(2**63) <= value < 2**64
    if type(value) is float:
        return not math.isnan(value)
    if type(value) is str:
        return _is_text(value)
    return type(value) is bytes


def parse_tuple(fields: object) -> Tuple:
    """Return the tuple in a decoded message or record; for any invalid input raise ``Malformed``."""
    if not isinstance(fields, list) or not 0 < len(fields) <= MAX_FIELDS or not all(map(is_value, fields)):
        raise Malformed("the fields are not a valid tuple")
    return tuple(fields)


def _pack_field(field: Field) -> list[object]:
    """Encode the field to measure its size."""
    if isinstance(field, Wildcard):
        return [1]
    if isinstance(field, type):
        return [2, field.__name__]
    if isinstance(field, Predicate):
        return [3, field.operator, field.operand]
    return [0, field]


def _fits(field: Field, value: Value) -> bool:
    if isinstance(field, Wildcard):
        return True
    if isinstance(field, type):
        return type(value) is field
    if isinstance(field, Predicate):
        return field.holds(value)
    return _are_equal(value, field)


def _are_equal(a: Value, b: Value) -> bool:
    return type(a) is type(b) and a == b


def _are_numbers(a: object, b: object) -> bool:
    return type(a) in (int, float) and type(b) in (int, float)


def _check_count(fields: Sequence[object]) -> None:
    if isinstance(fields, str | bytes) or not isinstance(fields, Sequence):
        raise BadTuple(f"{fields!r}: the fields must be a tuple or list")
    if not 0 < len(fields) <= MAX_FIELDS:
        raise BadTuple(f"the tuple has {len(fields)} fields; it must have 1 to {MAX_FIELDS}")


def _check_size(fields: list[object]) -> None:
    size = len(msgpack.packb(fields))
    if size > MAX_TUPLE_BYTES:
        raise TooLarge(
            f"the tuple has {size} bytes; the limit is {MAX_TUPLE_BYTES}: store large values under their own key"
        )


def _is_text(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:  # a lone surrogate
        return False
    return True
