"""Option: the options of a driver, converted from a free table; each error with its remedy."""

from __future__ import annotations

from typing import Annotated, TypeVar

from msgspec import Meta

from drivers.driver import MAX_FPS
from drivers.errors import UsageError
from formats.convert import Invalid, Unit, convert_table

T = TypeVar("T")
Port = Annotated[int, Meta(ge=1, le=65535)]
Fps = Annotated[float, Meta(ge=0, le=MAX_FPS), Unit("pictures a second")]
Host = Annotated[str, Meta(min_length=1, max_length=253, examples=["192.168.1.20"])]
Device = Annotated[str, Meta(min_length=1, description="a serial device", examples=["/dev/ttyUSB0"])]


def convert_options(kind: str, table: object, cls: type[T]) -> T:
    """The options in ``table`` as a ``cls``; raises ``UsageError`` that names the key and what to write instead."""
    try:
        return convert_table(table, cls)
    except Invalid as error:
        raise fault_of(kind, error.key, error.problem, error.remedy) from None


def fault_of(kind: str, key: str, problem: str, remedy: str) -> UsageError:
    """The error about one option."""
    return UsageError(f'driver "{kind}": option {key} {problem}; {remedy}')
