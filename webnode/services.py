"""Collect the services that the handlers of routes use.  All of them are called on the reactor's thread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from twisted.internet.defer import Deferred

from webnode.audit import AuditLog
from webnode.auth import Sessions
from webnode.diagnostics import Diagnostics
from webnode.event_log import EventLog
from webnode.failover import Fallbacks
from webnode.faults import FaultControl
from webnode.invite import Invites
from webnode.limits import AddressLimits
from webnode.stop_control import StopControl
from webnode.team_control import TeamControl


@dataclass(frozen=True)
class PictureReply:
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

    def receive_picture(self, uuid: str, jpeg: bytes, values: Mapping[str, float]) -> PictureReply:
        """Take a picture and measured values from a phone.

        Raises ``Refusal`` 400 if the picture cannot be used, 404 if the phone is not registered here, 429 if it sends
        too often.
        """

    def leave(self, uuid: str) -> None:
        """Remove a phone; does nothing if it is not registered here."""

    def close(self) -> Deferred[Any]:
        """Remove all phones; fires when they have left."""


@dataclass
class Services:
    """The services of one web node; a service that the node lacks is None, and ``feature_names`` does not list it."""

    control: TeamControl
    sessions: Sessions
    audit: AuditLog = field(default_factory=AuditLog)
    event_log: EventLog = field(default_factory=EventLog)
    fallbacks: Fallbacks = field(default_factory=Fallbacks)
    limits: AddressLimits = field(default_factory=AddressLimits)
    diagnostics: Diagnostics | None = None
    stop_control: StopControl | None = None
    faults: FaultControl | None = None
    phones: Phones | None = None
    invites: Invites | None = None

    @property
    def feature_names(self) -> list[str]:
        """Return the names of the optional services that this node has, for the page."""
        features: Mapping[str, object] = {
            "yard": self.control.get_map(),
            "survey": self.diagnostics,
            "halts": self.stop_control,
            "faults": self.faults,
            "phones": self.phones,
            "invites": self.invites,
        }
        return [name for name, service in features.items() if service is not None]
