"""Maker: what the registry asks of the kind "phone"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.phone.driver import PhoneDriver
from drivers.phone.option import checked, described
from drivers.reading import Description


def made(options: Mapping[str, object], name: str, clock: IReactorTime, connector: Any) -> PhoneDriver:
    """A driver of a phone; it opens no link, as looks are handed to it."""
    return PhoneDriver(options, clock)


def description(options: Mapping[str, object], name: str) -> Description:
    """What that phone is."""
    return described(checked(options))
