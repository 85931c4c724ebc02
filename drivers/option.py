"""Manifests and option types: what tools need to know about a kind of robot before its driver is imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from msgspec import Meta

from drivers.driver import MAX_FPS
from drivers.errors import UsageError
from formats.convert import InvalidValue, Unit, convert_table

T = TypeVar("T")
Port = Annotated[int, Meta(ge=1, le=65535)]
Fps = Annotated[float, Meta(ge=0, le=MAX_FPS), Unit("pictures a second")]
Host = Annotated[str, Meta(min_length=1, max_length=253, examples=["192.168.1.20"])]
Device = Annotated[str, Meta(min_length=1, description="a serial device", examples=["/dev/ttyUSB0"])]


@dataclass(frozen=True)
class Manifest:
    """One kind of robot; the constant ``MANIFEST`` of its module ``driver``.

    ``library`` is the additional module that the kind needs, ``extra`` the extra of this distribution that installs the
    module, ``when`` the case in which the module is needed (empty: always). ``example`` contains options of such a
    robot, and is empty if no options are required. ``is_on_cable`` is whether the option ``port`` may be a serial
    device.
    """

    library: str = ""
    extra: str = ""
    when: str = ""
    example: Mapping[str, object] = field(default_factory=dict)
    is_on_cable: bool = False


def convert_options(kind: str, table: object, cls: type[T]) -> T:
    """Convert ``table`` to the options class ``cls``; raise ``UsageError`` with the key, the problem and the remedy."""
    try:
        return convert_table(table, cls)
    except InvalidValue as error:
        raise make_option_error(kind, error.key, error.problem, error.remedy) from None


def make_option_error(kind: str, key: str, problem: str, remedy: str) -> UsageError:
    """Return the error for a problem of one option."""
    return UsageError(f'driver "{kind}": option {key} {problem}; {remedy}')
