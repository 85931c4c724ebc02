"""Tests of ``webnode.diagnostics`` and ``middleware.diagnostics.node_diagnostics`` with nodes in virtual time."""

from __future__ import annotations

from typing import Any

from middleware.diagnostics.node_diagnostics import LINKS_METHOD, NETWORK_METHOD, describe_network, expose_diagnostics
from middleware.entangled.control.link_quality import LinkQuality
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.record import hash_key
from middleware.entangled.wire.admission_check import OPEN_TEAM_WARNING
from middleware.frontend.client import TeamClient
from middleware.node import SwarmNode
from tests.fleet import FleetCase, SwarmTeam
from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryDiagnostics, MemoryTeamControl
from webnode.app import create_app
from webnode.diagnostics import ANSWER_LIMIT_S, Diagnostics
from webnode.errors import Refusal
from webnode.services import Services
from webnode.state import format_state


class DiagnosticsTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        self.team: SwarmTeam = self.swarm(3, weather=LinkConditions(delay_s=0.003))
        self.team.run(3)
        for node in self.team.nodes:
            expose_diagnostics(node)
        self.dogs = [node.uuid for node in self.team.nodes]
        client = TeamClient(self.team.nodes[0])
        self.team.run(1)
        self.diagnostics = Diagnostics(self.team.nodes[0], client)

    def network(self) -> Any:
        return self.done(self.team, self.diagnostics.query_network(), ANSWER_LIMIT_S + 1)

    def test_tell_who_knows_whom(self) -> None:
        """Each of three nodes, in the order of joining, lists the two other nodes with round trip and last contact."""
        told = self.network()
        self.assertEqual((list(told["devices"]), told["silent"]), (self.dogs, []))
        for place, view in enumerate(told["devices"].values()):
            others = {f"dog{other}" for other in range(3) if other != place}
            self.assertEqual({contact["name"] for contact in view["contacts"]}, others)
            self.assertTrue(all(0 < contact["rtt_ms"] < 50 for contact in view["contacts"]), view)
            self.assertTrue(all(contact["heard_s"] < 3 for contact in view["contacts"]), view)

    def test_ask_once_for_all_who_look(self) -> None:
        """Reads that are concurrent or follow closely cause only one request to each device."""
        asked: list[str] = []

        def expose(node: SwarmNode) -> None:
            def answer(peer: object) -> dict[str, int]:
                asked.append(node.uuid)
                return {"known": 2}

            node.entangled.endpoint.expose(NETWORK_METHOD, answer)

        for node in self.team.nodes[1:]:
            expose(node)
        waiting: list[Any] = [self.diagnostics.query_network() for _ in range(20)]
        self.team.run(0.5)
        waiting.append(self.diagnostics.query_network())
        self.assertEqual(len([self.successResultOf(each) for each in waiting]), 21)
        self.assertEqual(sorted(asked), sorted(self.dogs[1:]))
        self.team.run(1)
        self.network()
        self.assertEqual(len(asked), 4)

    def test_name_the_silent(self) -> None:
        """A device that does not reply is listed as silent; the other devices are shown in time."""
        self.team.nodes[2].stop_silently()
        waiting = self.diagnostics.query_network()
        self.team.run(ANSWER_LIMIT_S + 0.3)
        told: Any = self.successResultOf(waiting)
        self.assertEqual((list(told["devices"]), told["silent"]), (self.dogs[:2], self.dogs[2:]))

    def test_go_on_beside_one_without_an_address(self) -> None:
        """A device without a valid address is listed as silent; the other devices are shown."""
        self.team.nodes[2].presence.change(address="nowhere")
        self.team.run(1)
        told = self.network()
        self.assertEqual((list(told["devices"]), told["silent"]), (self.dogs[:2], self.dogs[2:]))

    def test_believe_nothing_unlawful(self) -> None:
        """Replies with an invalid structure are replaced by empty replies."""
        for told in ({"contacts": [3, {"uuid": 5}, {"uuid": "ab", "rtt_ms": "x"}], "lookups": 7, "sent": []}, "no", {}):
            self.team.nodes[1].entangled.endpoint.expose(NETWORK_METHOD, lambda peer, told=told: told)
            self.team.run(2)
            view = self.network()["devices"].get(self.dogs[1])
            if isinstance(told, dict):
                unknown = [{"uuid": "ab", "name": "ab", "rtt_ms": None, "heard_s": None}]
                self.assertEqual(view["contacts"], unknown if told else [])
                self.assertEqual((view["lookups"], view["sent"]), ([], 0))
            else:
                self.assertIsNone(view)

    def links(self) -> Any:
        return self.done(self.team, self.diagnostics.query_links(), ANSWER_LIMIT_S + 1)

    def test_tell_how_each_is_reached(self) -> None:
        """Each of three nodes lists its paths to the other two nodes.

        The scores of the paths are in the results of the second request.
        """
        told = self.links()
        self.assertEqual((told["here"], list(told["devices"]), told["silent"]), (self.dogs[0], self.dogs, []))
        self.assertEqual({way["score"] for view in told["devices"].values() for way in view["links"]}, {None})
        self.team.run(2)
        for place, view in enumerate(self.links()["devices"].values()):
            others = {f"dog{other}" for other in range(3) if other != place}
            self.assertEqual(({way["name"] for way in view["links"]}, view["refusals"]), (others, []))
            for way in view["links"]:
                self.assertEqual((way["way"], way["by"], way["loss"], way["score"]), ("machine", "", 0.0, 100))
                self.assertTrue(5 < way["rtt_ms"] < 8 and way["jitter_ms"] < 1 and way["for_s"] > 1, way)

    def test_tell_what_got_worse(self) -> None:
        """A path with loss and delay has a lower score than a good path, by the same rule as in ``swarm links``."""
        self.links()
        self.team.run(3)
        far = self.team.address(2)
        for near in (0, 1):
            self.team.switchboard.set_conditions(
                self.team.address(near), far, LinkConditions(delay_s=0.15, jitter_s=0.02)
            )
        for _ in range(6):
            self.team.run(2)
            told = self.links()
        scores = {way["name"]: way["score"] for way in told["devices"][self.dogs[0]]["links"]}
        self.assertEqual(scores["dog1"], 100)
        self.assertTrue(0 < scores["dog2"] < 80, scores)
        way = next(each for each in told["devices"][self.dogs[0]]["links"] if each["name"] == "dog2")
        judged = LinkQuality(way["loss"], way["rtt_ms"] / 1000, way["jitter_ms"] / 1000, False).score
        self.assertEqual(way["score"], judged)

    def test_carrying_costs(self) -> None:
        """Of two paths with equal measurements the relayed path has the lower score; its relay is listed."""
        ways = [
            {"id": uuid, "way": way, "by": by, "loss": 0.0, "round_trip": 0.002, "jitter": 0.0}
            for uuid, way, by in ((self.dogs[0], "punched", ""), (self.dogs[2], "carried", self.dogs[0]))
        ]
        self.team.nodes[1].entangled.endpoint.expose(LINKS_METHOD, lambda peer: {"links": ways, "refusals": []})
        punched, carried = self.links()["devices"][self.dogs[1]]["links"]
        self.assertEqual((punched["score"], punched["by"]), (100, ""))
        self.assertEqual((carried["score"], carried["by"]), (LinkQuality(0.0, 0.002, 0.0, True).score, "dog0"))
        self.assertLess(carried["score"], 100)

    def test_believe_no_unlawful_way(self) -> None:
        """Invalid kinds, sides and numbers in the paths of a device are replaced by valid values."""
        way = {"id": "ab", "way": "magic", "loss": 7, "round_trip": float("nan"), "for": -1, "by": 3, "address": ["x"]}
        refusal = {"who": "x\n" * 99, "side": 3, "code": None, "reason": "why; do; this", "ago": "y", "count": 1.5}
        answer = {"links": [way, {"id": 4}, 5], "refusals": [refusal, "x"]}
        self.team.nodes[1].entangled.endpoint.expose(LINKS_METHOD, lambda peer: answer)
        view = self.links()["devices"][self.dogs[1]]
        ((only,), (refused,)) = view["links"], view["refusals"]
        self.assertEqual((only["way"], only["loss"], only["score"], only["for_s"]), ("none", 1.0, 0, None))
        self.assertEqual((refused["side"], refused["why"], refused["remedy"]), ("we", "why", "do; this"))
        self.assertEqual((refused["ago_s"], refused["count"], len(refused["who"]) <= 64), (0.0, 1, True))

    def test_open_team(self) -> None:
        """The diagnostics of an open team list which protections are missing."""
        told: Any = self.diagnostics.describe_team()
        self.assertEqual((told["kind"], told["unprotected"]), ("open", OPEN_TEAM_WARNING))

    def test_tell_what_is_stored(self) -> None:
        """The inventory of this node and of another node counts the records by kind and lists the newest record."""
        self.done(self.team, self.team.nodes[1].entangled.put(hash_key("a"), "note", b"\xa1x", "team"), 1)
        for uuid in self.dogs[:2]:
            told: Any = self.done(self.team, self.diagnostics.query_inventory(uuid), 1)
            self.assertEqual(told["kinds"], {"devices": 3, "other": 1})
            self.assertEqual((told["records"], told["deleted"]), (4, 0))
            kind, name, size, lifetime = told["newest"][0]
            self.assertEqual((kind, name, lifetime), ("other", "note", "team"))
            self.assertTrue(0 < size < told["bytes"] < told["most_bytes"])

    def test_say_who_did_not_answer(self) -> None:
        """A request to a silent device gives status 504.

        A request to a device without the method, or to a missing device, gives status 409.
        """
        self.assertEqual(self.assertRaises(Refusal, self.diagnostics.query_inventory, "ff").status, 409)
        self.team.nodes[1].entangled.endpoint.expose("device.inventory", _refuse)
        waiting = self.diagnostics.query_inventory(self.dogs[1])
        self.team.run(1)
        self.assertEqual(self.failureResultOf(waiting, Refusal).value.status, 409)
        self.team.nodes[2].stop_silently()
        waiting = self.diagnostics.query_inventory(self.dogs[2])
        self.team.run(ANSWER_LIMIT_S + 0.3)
        refusal = self.failureResultOf(waiting, Refusal).value
        self.assertEqual((refusal.status, refusal.problem), (504, "dog2 did not answer"))

    def test_remember_lookups(self) -> None:
        """A lookup is recorded with its requests, hops and results."""
        large = self.swarm(12, weather=LinkConditions(delay_s=0.003))
        large.run(3)
        node: SwarmNode = large.nodes[11]
        self.done(large, node.entangled.find_node(hash_key("x")), 1)
        lookups = describe_network(node)["lookups"]
        self.assertTrue(lookups)
        for each in lookups:
            self.assertTrue(1 <= each["hops"] <= each["asked"] and each["found"] == 8 and each["ms"] > 0, each)

    def test_ask_by_http(self) -> None:
        """Viewers read the diagnostics.

        An unknown device gives 404, a silent device 504, a node without diagnostics 409.
        """
        state = format_state([{"uuid": "01", "name": "dog1"}, {"uuid": "02", "name": "dog2"}], [], {})
        others: Any = ({"here": "01", "devices": {}, "silent": []}, {"kind": "open", "unprotected": "much"})
        diagnostics = MemoryDiagnostics({"devices": {}, "silent": ["02"]}, {"01": {"records": 4}}, *others)

        def asked(services: Services, path: str) -> tuple[int, Any]:
            client = create_app(lambda: state, services).test_client()
            answer = client.get(f"/api/v1/{path}?ticket=viewer", headers={"Host": "localhost"})
            return answer.status_code, answer.get_json()

        services = Services(MemoryTeamControl(), Guests(), diagnostics=diagnostics)
        self.assertEqual(asked(services, "network"), (200, {"devices": {}, "silent": ["02"]}))
        self.assertEqual((asked(services, "links"), asked(services, "team")), ((200, others[0]), (200, others[1])))
        self.assertEqual(asked(services, "devices/01/inventory"), (200, {"records": 4}))
        self.assertEqual([asked(services, f"devices/{uuid}/inventory")[0] for uuid in ("02", "03")], [504, 404])
        for path in ("network", "links", "team"):
            self.assertEqual(asked(Services(MemoryTeamControl(), Guests()), path)[0], 409)


def _refuse(peer: object, too: int, many: int) -> None:
    """Raise an exception, because it takes more arguments than the caller passes."""
