"""Stop and release the whole team from the page."""

from __future__ import annotations

import re
from collections.abc import Sequence

from twisted.internet.defer import Deferred

from middleware.frontend.client import TeamClient
from middleware.stop.stop_set import ID_BYTES
from webnode.errors import Refusal


class StopControl:
    """Stops the team through ``client``; results map each uuid to ``stands`` or to the reason why it does not stand."""

    def __init__(self, client: TeamClient) -> None:
        self._client = client

    def stop(self, by: str) -> Deferred[dict[str, str]]:
        """Stop all robots until a release."""
        return self._client.stop_all(by)

    def release(self, by: str, stops: Sequence[str] | None = None) -> Deferred[dict[str, str]]:
        """End the given stops, by default all that this node or a device knows; raises ``Refusal`` for a bad id."""
        named = self._list_known() if stops is None else [_parse_id(stop) for stop in stops]
        return self._client.release(named, by)

    def _list_known(self) -> list[bytes]:
        view = self._client.view
        obeyed = [stop for device in view.devices for stop in device.stops]
        return [_parse_id(stop) for stop in (*view.stops, *obeyed) if is_stop_id(stop)]


def is_stop_id(stop: str) -> bool:
    """Return whether ``stop`` is the id of a stop in hex."""
    return re.fullmatch(f"[0-9a-f]{{{2 * ID_BYTES}}}", stop) is not None


def _parse_id(stop: object) -> bytes:
    if not isinstance(stop, str) or not is_stop_id(stop):
        raise Refusal("stops", "a stop has an invalid id", "use ids of /api/v1/state, or omit the field")
    return bytes.fromhex(stop)
