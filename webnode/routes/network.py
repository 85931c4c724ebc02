"""Routes of the network: contacts, paths, the team, and the stored records of each device."""

from __future__ import annotations

from typing import Any

from webnode.errors import Refusal
from webnode.route import API, DEVICE, Ask, Route, device
from webnode.survey import TeamSurvey


def network(ask: Ask) -> Any:
    """Return the contacts of each device and their round-trip times."""
    return _survey(ask).network()


def links(ask: Ask) -> Any:
    """Return the path and its quality from each device to the others."""
    return _survey(ask).links()


def team(ask: Ask) -> Any:
    """Return the kind of team and its members."""
    return _survey(ask).team()


def inventory(ask: Ask) -> Any:
    """Return the records that a device stores."""
    return _survey(ask).inventory(device(ask)["uuid"])


def _survey(ask: Ask) -> TeamSurvey:
    if ask.board.survey is None:
        raise Refusal("node", "it cannot query devices", "use another web node of the team", 409)
    return ask.board.survey


ROUTES = (
    Route(
        "GET",
        f"{API}/network",
        "Contacts of each device with round-trip times, traffic and the newest lookups; queries each device",
        "viewer",
        network,
        gives="devices (by uuid: contacts, known, sent, received, lost, lookups), silent",
    ),
    Route(
        "GET",
        f"{API}/links",
        "Path and measured quality from each device to the others, and refused nodes; measured while a client asks",
        "viewer",
        links,
        gives="here (this node), devices (by uuid: links, refusals), silent",
    ),
    Route(
        "GET",
        f"{API}/team",
        "Open or closed team; for a closed one its members, their roles, and the expiry of their certificates",
        "viewer",
        team,
        gives="kind; unprotected, or name, fingerprint, me, until, is_renewable, is_ending, known, members",
    ),
    Route(
        "GET",
        f"{API}/devices/{{uuid}}/inventory",
        "Records that a device stores; queries the device",
        "viewer",
        inventory,
        (DEVICE,),
        gives="records, deleted, bytes, most_bytes, kinds, newest (kind, name, bytes, lifetime)",
    ),
)
