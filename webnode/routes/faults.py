"""Routes of fault injection."""

from __future__ import annotations

from typing import Any

from middleware.faults.kinds import DEFAULT_S, KINDS, MAX_S, MIN_S
from webnode.errors import Refusal
from webnode.route import API, DEVICE, Field, Route, RouteRequest, find_device
from webnode.sanitize import Json


def list_faults(request: RouteRequest) -> Json:
    """Return the kinds of faults, the devices that allow them, and active faults; empty without fault injection."""
    control = request.services.faults
    if control is None:
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
    can: dict[str, Json] = {each["uuid"]: list(control.get_kinds(each["uuid"])) for each in request.state["devices"]}
    active: list[Json] = list(control.list_active())
    return {"kinds": kinds, "can": can, "active": active}


def inject_fault(request: RouteRequest) -> Any:
    """Inject a fault into a device."""
    uuid, services, kind = find_device(request)["uuid"], request.services, request.values["kind"]
    if services.faults is None:
        raise Refusal(
            "device", "fault injection is off on this node", 'set "allow = true" below [faults] in its settings', 409
        )
    seconds, amount = request.values["seconds"], request.values["amount"]

    def record_fault(_: object) -> Json:
        services.event_log.record_fault(uuid, kind, request.now)
        return {"id": uuid, "kind": kind, "seconds": seconds}

    return services.faults.inject(uuid, kind, seconds, amount).addCallback(record_fault)


_USUAL = "; ".join(f"{name}: {kind.amount:g} {kind.unit}" for name, kind in KINDS.items() if kind.unit)
ROUTES = (
    Route(
        "GET",
        f"{API}/faults",
        "Faults that can be injected, and injected faults with their takeover times",
        "viewer",
        list_faults,
        response="kinds, can (kinds by uuid), "
        "active (n, uuid, name, kind, amount, left_s, since_s, task, takeover_s, to)",
    ),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/faults",
        "Inject a fault into a device that allows it; the fault ends by itself",
        "operator",
        inject_fault,
        (
            DEVICE,
            Field("kind", "choice", "kind of fault", choices=tuple(KINDS)),
            Field(
                "seconds",
                "number",
                "duration",
                minimum=MIN_S,
                maximum=MAX_S,
                default=DEFAULT_S,
                unit="s",
            ),
            Field("amount", "number", f"strength, for kinds with an amount (usual {_USUAL})", default=None),
        ),
        response="id, kind, seconds",
        status=202,
    ),
)
