"""Collect the services that the answers of routes use.  All of them are called on the reactor's thread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from twisted.internet.defer import Deferred

from webnode.audit import Audit
from webnode.chronicle import TeamChronicle
from webnode.fallback import Fallbacks
from webnode.faults import FaultControl
from webnode.halting import TeamHalts
from webnode.invite import TeamInvites
from webnode.limits import AddressLimits
from webnode.survey import TeamSurvey
from webnode.team import TeamDesk
from webnode.visitor import Sessions


@dataclass(frozen=True)
class Wanted:
    """The reply to a phone's picture: requested pictures per second, and a text to show on the phone."""

    fps: float
    say: str = ""


class Phones(Protocol):
    """Phones that take part as devices; this node connects them to the team."""

    def join(self, secret: bytes, name: str, can: Mapping[str, Any]) -> Deferred[str]:
        """Register a phone; fires with its uuid, which is the same for the same secret at every web node.

        ``can`` has the ``width`` and ``height`` of its pictures in pixels, and whether the phone measures
        ``orientation`` and ``position``.  Fails with ``Refusal`` 409 or 429 if the phone is not accepted, 503 if phones
        are not available here.
        """

    def look(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> Wanted:
        """Take a picture and measured values from a phone.

        Raises ``Refusal`` 400 if the picture cannot be used, 404 if the phone is not registered here, 429 if it sends
        too often.
        """

    def leave(self, uuid: str) -> None:
        """Remove a phone; does nothing if it is not registered here."""

    def close(self) -> Deferred[Any]:
        """Remove all phones; fires when they have left."""


@dataclass
class Board:
    """The services of one web node; a service that the node lacks is None, and ``has`` tells the page so."""

    desk: TeamDesk
    sessions: Sessions
    audit: Audit = field(default_factory=Audit)
    chronicle: TeamChronicle = field(default_factory=TeamChronicle)
    fallbacks: Fallbacks = field(default_factory=Fallbacks)
    limits: AddressLimits = field(default_factory=AddressLimits)
    survey: TeamSurvey | None = None
    halts: TeamHalts | None = None
    faults: FaultControl | None = None
    phones: Phones | None = None
    invites: TeamInvites | None = None

    @property
    def has(self) -> list[str]:
        """Return the names of the optional services that this node has, for the page."""
        parts = ("survey", "halts", "faults", "phones", "invites")
        yard = ["yard"] if self.desk.yard() is not None else []
        return yard + [name for name in parts if getattr(self, name) is not None]
