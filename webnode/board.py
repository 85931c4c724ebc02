"""The board: all that the answers of the page's routes may use.  Everything is called on the reactor's thread."""

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
    """What a phone is asked for: so many pictures a second, and words for who holds it."""

    fps: float
    say: str = ""


class Phones(Protocol):
    """Phones that take part as devices, with this node as their way into the team."""

    def join(self, secret: bytes, name: str, can: Mapping[str, Any]) -> Deferred[str]:
        """Let a phone take part; fires with its uuid, which is the same for the same secret at every web node.

        ``can`` is what it has: ``width`` and ``height`` of its pictures in pixels, and whether it tells ``orientation``
        and ``position``.  Fails with ``Refusal`` 409 or 429 where it may not, 503 where that cannot be.
        """

    def look(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> Wanted:
        """Take what it sees and measures.

        Raises ``Refusal`` 400 where it is no picture that is used, 404 where the phone takes no part here, 429 where it
        looks too often.
        """

    def leave(self, uuid: str) -> None:
        """Let it go; one that is not here has gone already."""

    def close(self) -> Deferred[Any]:
        """Let all of them go; fires when they have."""


@dataclass
class Board:
    """All that the answers may use; None is a part that the node lacks, which the page, told by ``has``, leaves out."""

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
        """What this node has beyond what every web node has, for the page."""
        parts = ("survey", "halts", "faults", "phones", "invites")
        yard = ["yard"] if self.desk.yard() is not None else []
        return yard + [name for name in parts if getattr(self, name) is not None]
