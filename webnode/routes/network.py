"""Routes of the network: who knows whom, by which ways, in what team, and what each device stores."""

from __future__ import annotations

from typing import Any

from webnode.errors import Refusal
from webnode.route import API, DEVICE, Ask, Route, device
from webnode.survey import TeamSurvey


def network(ask: Ask) -> Any:
    """Who knows whom, and how far they are."""
    return _survey(ask).network()


def links(ask: Ask) -> Any:
    """How each reaches the others."""
    return _survey(ask).links()


def team(ask: Ask) -> Any:
    """What team this is."""
    return _survey(ask).team()


def inventory(ask: Ask) -> Any:
    """What a device stores."""
    return _survey(ask).inventory(device(ask)["uuid"])


def _survey(ask: Ask) -> TeamSurvey:
    if ask.board.survey is None:
        raise Refusal("node", "it cannot ask devices", "ask another web node of the team", 409)
    return ask.board.survey


ROUTES = (
    Route(
        "GET",
        f"{API}/network",
        "Who knows whom, with round trips, traffic and the newest lookups; each device is asked",
        "viewer",
        network,
        gives="devices (by uuid: contacts, known, sent, received, lost, lookups), silent",
    ),
    Route(
        "GET",
        f"{API}/links",
        "By which way each device reaches the others, and how well, measured while somebody asks; who was not let in",
        "viewer",
        links,
        gives="here (this node), devices (by uuid: links, refusals), silent",
    ),
    Route(
        "GET",
        f"{API}/team",
        "Open or closed; of a closed team its members, their roles, and until when they are certified",
        "viewer",
        team,
        gives="kind; unprotected, or name, fingerprint, me, until, is_renewable, is_ending, known, members",
    ),
    Route(
        "GET",
        f"{API}/devices/{{uuid}}/inventory",
        "What a device stores; the device is asked",
        "viewer",
        inventory,
        (DEVICE,),
        gives="records, deleted, bytes, most_bytes, kinds, newest (kind, name, bytes, lifetime)",
    ),
)
