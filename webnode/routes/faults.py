"""Routes of fault injection."""

from __future__ import annotations

from typing import Any

from middleware.faults.kinds import KINDS, MAX_S, MIN_S, USUAL_S
from webnode.errors import Refusal
from webnode.field import Json
from webnode.route import API, DEVICE, Ask, Field, Route, device


def faults(ask: Ask) -> Json:
    """Return the kinds of faults, the devices that allow them, and active faults; empty without fault injection."""
    known = ask.board.faults
    if known is None:
        return {"kinds": [], "can": {}, "active": []}
    kinds: list[Json] = [
        {
            "kind": name,
            "about": kind.about,
            "is_lost": kind.is_lost,
            "unit": kind.unit,
            "means": kind.means,
            "amount": kind.amount,
            "least": kind.least,
            "most": kind.most,
        }
        for name, kind in KINDS.items()
    ]
    can: dict[str, Json] = {each["uuid"]: list(known.kinds(each["uuid"])) for each in ask.state["devices"]}
    active: list[Json] = list(known.active())
    return {"kinds": kinds, "can": can, "active": active}


def cause(ask: Ask) -> Any:
    """Inject a fault into a device."""
    uuid, board, kind = device(ask)["uuid"], ask.board, ask.given["kind"]
    if board.faults is None:
        raise Refusal(
            "device", "this node does not inject faults", 'set "allow = true" below [faults] in its settings', 409
        )
    seconds, amount = ask.given["seconds"], ask.given["amount"]

    def taken(_: object) -> Json:
        board.chronicle.faulted(uuid, kind, ask.now)
        return {"id": uuid, "kind": kind, "seconds": seconds}

    return board.faults.cause(uuid, kind, seconds, amount).addCallback(taken)


_USUAL = "; ".join(f"{name}: {kind.amount:g} {kind.unit}" for name, kind in KINDS.items() if kind.unit)
ROUTES = (
    Route(
        "GET",
        f"{API}/faults",
        "Faults that can be injected, and injected faults with their takeover times",
        "viewer",
        faults,
        gives="kinds, can (kinds by uuid), active (n, uuid, name, kind, amount, left_s, since_s, task, takeover_s, to)",
    ),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/faults",
        "Inject a fault into a device that allows it; the fault ends by itself",
        "operator",
        cause,
        (
            DEVICE,
            Field("kind", "choice", "kind of fault", choices=tuple(KINDS)),
            Field(
                "seconds",
                "number",
                "duration",
                least=MIN_S,
                most=MAX_S,
                default=USUAL_S,
                unit="s",
            ),
            Field("amount", "number", f"strength, for kinds with an amount (usual {_USUAL})", default=None),
        ),
        gives="id, kind, seconds",
        status=202,
    ),
)
