"""Manifest: the facts about a kind of robot that tools show before a robot is there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


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
