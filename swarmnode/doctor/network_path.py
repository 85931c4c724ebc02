"""Checks of ``swarm doctor`` on the network path: interfaces, firewalls, access points, routers."""

from __future__ import annotations

from collections.abc import Iterator

from middleware.entangled.network.interface import is_any
from swarmnode.doctor.facts import Facts, Finding, Probe, is_local, make_error, make_note, make_warning


def check_interface(facts: Facts) -> Iterator[Finding]:
    """Check that the node listens on an interface that reaches the other nodes."""
    far = [probe for probe in facts.known if not is_local(probe.address.host)]
    outside = [each for each in facts.interfaces if not each.is_loopback and each.addresses]
    if is_local(facts.host):
        if far:
            yield make_error(
                "wrong-interface",
                "The node accepts only connections from this machine.",
                f"[node] host is {facts.host}, but {far[0].address} is on another machine.",
                f"Set [node] host to {_suggest_address(facts)}.",
            )
        return
    if not outside:
        yield make_error(
            "offline",
            "This machine has no network.",
            "Only the loopback interface is up and has an address.",
            "Join a network, or plug in the cable.",
        )
        return
    if is_any(facts.host):
        return
    at = [each for each in facts.interfaces if facts.host in each.addresses]
    if not at:
        yield make_error(
            "wrong-interface",
            "The node's address is not an address of this machine.",
            f"[node] host is {facts.host}; this machine has {_list_addresses(facts)}.",
            f"Set [node] host to {_suggest_address(facts)}.",
        )
    elif not at[0].is_running:
        yield make_error(
            "wrong-interface",
            f"The interface {at[0].name} is not connected.",
            f"[node] host {facts.host} is the address of this interface, which has no carrier.",
            f"Connect the interface, or set [node] host to {_suggest_address(facts, at[0].name)}.",
        )
    elif (
        facts.source_address
        and facts.source_address != facts.host
        and not any(probe.has_reply for probe in facts.known)
    ):
        yield make_error(
            "wrong-interface",
            "The node does not listen on the interface that reaches the known nodes.",
            f"[node] host is {facts.host} ({at[0].name}), but this machine reaches them from {facts.source_address}.",
            f"Set [node] host to {facts.source_address}.",
        )


def check_known_nodes(facts: Facts) -> Iterator[Finding]:
    """Report why known nodes do not reply; a cause is reported once."""
    silent = [probe for probe in facts.known if not probe.has_reply]
    for probe in [each for each in silent if each.error == "refused"]:
        yield make_warning(
            "nobody-listens",
            f"No node listens at {probe.address}.",
            "The machine replies that the port is closed.",
            "Start that node, or fix its address in [node] known_nodes.",
        )
    yield from _check_neighbours(facts, silent)
    far = [probe for probe in silent if not probe.is_near and not probe.error and not is_local(probe.address.host)]
    heard_far = any(probe.has_reply and not probe.is_near for probe in facts.known)
    spoken = [probe for probe in far if probe.is_tcp]
    if spoken and not heard_far:
        yield make_error(
            "udp-blocked",
            "UDP is blocked between this machine and the known nodes.",
            f"{spoken[0].address.host} replies to TCP, but not to UDP.",
            f"Allow outgoing UDP from port {facts.port or '(all)'}, or set [node] tunnels to a node with port 443.",
        )


def _check_neighbours(facts: Facts, silent: list[Probe]) -> Iterator[Finding]:
    """Report silent nodes on the same subnet."""
    near = [probe for probe in silent if probe.is_near and probe.error != "refused"]
    hidden = [probe for probe in near if probe.is_resolved is False]
    others = [probe for probe in facts.known if probe.has_reply and probe.is_near]
    if hidden and not others and not facts.other_answers and facts.is_gateway_resolved:
        yield make_error(
            "client-isolation",
            "This network isolates its clients from each other, or those nodes are off.",
            f"The router replies, but {hidden[0].address.host} on the same subnet does not.",
            "Switch off client isolation (AP isolation, guest mode) at the access point, or use another network; "
            "or give all nodes a known node on the internet, which acts as a relay.",
        )
    elif hidden:
        yield make_warning(
            "off",
            f"{hidden[0].address.host} is not on this network now.",
            "Its address is in the same subnet, but its hardware does not reply.",
            "Switch on that machine, or fix its address in [node] known_nodes.",
        )
    for probe in [each for each in near if each.is_resolved]:
        yield make_error(
            "peer-firewall",
            f"The machine {probe.address.host} drops datagrams to port {probe.address.port}.",
            "Its hardware replies on this subnet, but there is neither a reply nor a closed-port error.",
            f"Allow incoming UDP {probe.address.port} in its firewall.",
        )


def check_multicast(facts: Facts) -> Iterator[Finding]:
    """Check that nodes can discover each other on the LAN."""
    lan = facts.lan
    if lan is None:
        return
    near = [probe for probe in facts.known if probe.answer is not None and probe.is_near]
    near = [probe for probe in near if probe.address.host not in facts.own_addresses]
    if not lan.is_sent:
        yield make_warning(
            "multicast-blocked",
            "This machine cannot send multicast datagrams.",
            "The system rejected them on every interface.",
            "Allow UDP 8483 to 239.192.83.87 in its firewall, or set [node] known_nodes.",
        )
    elif not lan.has_received_own:
        yield make_warning(
            "multicast-blocked",
            "This machine does not receive multicast datagrams.",
            "It did not receive its own multicast probe.",
            "Allow incoming UDP 8483 in its firewall, or set [node] known_nodes.",
        )
    elif near and not facts.other_answers:
        yield make_warning(
            "multicast-blocked",
            "This network does not forward multicast.",
            f"{near[0].address} replies to a direct probe, but no node replies to a multicast probe.",
            "Switch on multicast (IGMP snooping off, or with a querier) at the switch or access point; "
            "until then set [node] known_nodes.",
        )


def report_nat(facts: Facts) -> Iterator[Finding]:
    """Report the kind of NAT router, judged by the addresses at which other nodes see this machine."""
    seen = [answer.seen for answer in facts.answers if answer.seen is not None]
    seen = [each for each in seen if not is_local(each.host) and each.host not in facts.own_addresses]
    if not seen:
        return
    hosts, ports = {each.host for each in seen}, {(each.host, each.port) for each in seen}
    if len(hosts) == 1 and len(ports) > 1:
        yield make_warning(
            "nat-symmetric",
            "The router assigns a different port for each peer (symmetric NAT).",
            f"Other nodes see one port of this machine as {', '.join(sorted(f'{h}:{p}' for h, p in ports))}.",
            "Nodes behind such routers can reach this node by relay only; forward a UDP port to this machine, and set "
            "[node] port to it.",
        )
    elif len(seen) > 1:
        yield make_note(
            "nat-cone",
            "The router keeps one port for all peers, so nodes behind other routers can be reached directly.",
            f"{len(seen)} nodes see this machine at {seen[0]}.",
            "None.",
        )
    else:
        yield make_note(
            "nat",
            "This machine is behind a router with address translation (NAT).",
            f"Other nodes see it at {seen[0]}.",
            "None; to determine the kind of router, add a second known node.",
        )


def check_bootstrap(facts: Facts) -> Iterator[Finding]:
    """Report that no bootstrap node is reachable, unless another problem explains this."""
    if facts.answers or any(probe.has_reply for probe in facts.known) or (facts.health and facts.health.contacts):
        return
    explained = [probe for probe in facts.known if probe.error or probe.is_resolved is False]
    if facts.known and len(explained) == len(facts.known):
        return
    if facts.known:
        yield make_error(
            "no-bootstrap",
            "None of the known nodes replies.",
            f"Probed: {', '.join(str(probe.address) for probe in facts.known)}.",
            "Start one of these nodes, or fix [node] known_nodes.",
        )
    else:
        yield make_warning(
            "no-bootstrap",
            "No other node was found.",
            "[node] known_nodes is empty, and no node replies on the LAN.",
            "Start another node on this LAN, or set [node] known_nodes; the first node of a team is alone.",
        )


def _list_addresses(facts: Facts) -> str:
    return ", ".join(f"{' '.join(i.addresses)} ({i.name})" for i in facts.interfaces if i.addresses) or "none"


def _suggest_address(facts: Facts, but: str = "") -> str:
    if facts.source_address and not is_local(facts.source_address):
        return facts.source_address
    usable = [i for i in facts.interfaces if not i.is_loopback and i.addresses and i.is_running and i.name != but]
    return usable[0].addresses[0] if usable else "an address of this machine on the team's network"
