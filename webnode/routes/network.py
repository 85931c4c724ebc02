"""Routes of the network: contacts, paths, the team, and the stored records of each device."""

from __future__ import annotations

from typing import Any

from webnode.diagnostics import Diagnostics
from webnode.errors import Refusal
from webnode.route import API, DEVICE, Route, RouteRequest, find_device


def read_network(request: RouteRequest) -> Any:
    """Return the contacts of each device and their round-trip times."""
    return _require_diagnostics(request).query_network()


def read_links(request: RouteRequest) -> Any:
    """Return the path and its quality from each device to the others."""
    return _require_diagnostics(request).query_links()


def read_team(request: RouteRequest) -> Any:
    """Return the kind of team and its members."""
    return _require_diagnostics(request).describe_team()


def read_inventory(request: RouteRequest) -> Any:
    """Return the records that a device stores."""
    return _require_diagnostics(request).query_inventory(find_device(request)["uuid"])


def _require_diagnostics(request: RouteRequest) -> Diagnostics:
    if request.services.diagnostics is None:
        raise Refusal("node", "this node cannot query devices", "use another web node of the team", 409)
    return request.services.diagnostics


ROUTES = (
    Route(
        "GET",
        f"{API}/network",
        "Contacts of each device with round-trip times, traffic and the newest lookups; queries each device",
        "viewer",
        read_network,
        response="devices (by uuid: contacts, known, sent, received, lost, lookups), silent",
    ),
    Route(
        "GET",
        f"{API}/links",
        "Path and measured quality from each device to the others, and refused nodes; measured while a client asks",
        "viewer",
        read_links,
        response="here (this node), devices (by uuid: links, refusals), silent",
    ),
    Route(
        "GET",
        f"{API}/team",
        "Open or closed team; for a closed one its members, their roles, and the expiry of their certificates",
        "viewer",
        read_team,
        response="kind; unprotected, or name, fingerprint, me, until, is_renewable, is_ending, known, members",
    ),
    Route(
        "GET",
        f"{API}/devices/{{uuid}}/inventory",
        "Records that a device stores; queries the device",
        "viewer",
        read_inventory,
        (DEVICE,),
        response="records, deleted, bytes, most_bytes, kinds, newest (kind, name, bytes, lifetime)",
    ),
)
