"""Option: what tools know of a kind of robot before one is there: its manifest, and the types of its options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
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


@dataclass(frozen=True)
class Manifest:
    """One kind of robot; the constant ``MANIFEST`` of its module ``driver``.

    ``library`` is the module that it needs beyond those of every node, ``extra`` the extra of this distribution that
    installs it, and ``when`` the case in which it is needed, empty for always.  ``example`` are options that describe
    such a robot; a kind that needs no option has none.  ``is_on_cable`` says that ``port`` may be a serial device.
    """

    library: str = ""
    extra: str = ""
    when: str = ""
    example: Mapping[str, object] = field(default_factory=dict)
    is_on_cable: bool = False


def convert_options(kind: str, table: object, cls: type[T]) -> T:
    """The options in ``table`` as a ``cls``; raises ``UsageError`` that names the key and what to write instead."""
    try:
        return convert_table(table, cls)
    except Invalid as error:
        raise fault_of(kind, error.key, error.problem, error.remedy) from None


def fault_of(kind: str, key: str, problem: str, remedy: str) -> UsageError:
    """The error about one option."""
    return UsageError(f'driver "{kind}": option {key} {problem}; {remedy}')
