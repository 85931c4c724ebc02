"""Routes of the metrics: the state of the team in the Prometheus text format, by the library prometheus_client.

Values are read at each request.  The library is imported at the first request; its global registry is not used, because
it would add permanent metrics of this process.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, get_args

from webnode.errors import Refusal
from webnode.limits import CountedKind
from webnode.route import Content, Route, RouteRequest
from webnode.services import Services
from webnode.state import State

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""The format that every version of Prometheus supports."""
TRAFFIC_COUNTERS = ("sent", "received", "dropped")


def make_exposition(state: State, services: Services, now: float) -> bytes:
    """Return the exposition; ``now`` is unix seconds.  Raises ``ModuleNotFoundError`` without the library."""
    from prometheus_client import CollectorRegistry
    from prometheus_client.exposition import generate_latest

    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(list(_make_families(state, services, now))))
    text: bytes = generate_latest(registry)
    return text


class _Collector:
    def __init__(self, families: list[Any]) -> None:
        self._families = families

    def collect(self) -> Iterable[Any]:
        return self._families

    def describe(self) -> Iterable[Any]:
        return ()


def _make_families(state: State, services: Services, now: float) -> Iterator[Any]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    def by_status(name: str, description: str, rows: Any) -> Any:
        family = GaugeMetricFamily(name, description, labels=("status",))
        for status, count in sorted(Counter(row["status"] for row in rows).items()):
            family.add_metric([status], count)
        return family

    devices = list(state["devices"])
    yield by_status("swarm_devices", "Devices by status; recently departed ones as GONE.", devices)
    yield by_status("swarm_tasks", "Tasks by status.", state["tasks"])
    contacts = GaugeMetricFamily("swarm_device_contacts", "Nodes in a device's contacts.", labels=("uuid", "device"))
    since = GaugeMetricFamily("swarm_device_joined_seconds", "Unix time of joining.", labels=("uuid", "device"))
    flow = CounterMetricFamily("swarm_device_datagrams", "Datagrams of a device.", labels=("uuid", "device", "flow"))
    for device in devices:
        labels, network = [device["uuid"], device["name"]], device["network"]
        since.add_metric(labels, device["since"])
        if "contacts" in network:
            contacts.add_metric(labels, network["contacts"])
        for name in TRAFFIC_COUNTERS:
            if name in network:
                flow.add_metric([*labels, name], network[name])
    yield from (contacts, since, flow)
    agree = GaugeMetricFamily("swarm_group_agreeing", "Members of a group that agree.", labels=("task",))
    members = GaugeMetricFamily("swarm_group_members", "Members of a group.", labels=("task",))
    for group in state["groups"]:
        agree.add_metric([group["task"]], group["agree"])
        members.add_metric([group["task"]], group["of"])
    yield from (agree, members)
    connections = GaugeMetricFamily(
        "swarm_page_connections",
        "Connections of this node's page: open, with an incomplete request, with a response in progress.",
        labels=("kind",),
    )
    for kind in get_args(CountedKind):
        connections.add_metric([kind], services.limits.get_total(kind))
    yield connections
    orders = CounterMetricFamily(
        "swarm_page_orders", "Requests for changes through this node.", labels=("role", "status")
    )
    for (role, status), count in sorted(services.audit.get_counts().items()):
        orders.add_metric([role, status], count)
    yield orders
    yield GaugeMetricFamily("swarm_page_time_seconds", "Unix time at this node.", value=now)


def read_metrics(request: RouteRequest) -> Content:
    """Return all metrics."""
    try:
        return Content(make_exposition(request.state, request.services, request.now), MEDIA_TYPE)
    except ModuleNotFoundError as error:
        if error.name != "prometheus_client":
            raise
        remedy = "install it with: pip install 'swarm-node[web]'"
        raise Refusal("metrics", "the library prometheus-client is not installed", remedy, 404) from error


ROUTES = (
    Route(
        "GET",
        "/metrics",
        "Metrics of the team and the page, for Prometheus",
        "viewer",
        read_metrics,
        response="text/plain",
    ),
)
