"""Tests of ``swarmnode.gateway``: phones as devices of a team, in virtual time."""

from __future__ import annotations

import random
from collections.abc import Mapping
from functools import partial

from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import DEVICES, parse_devices
from middleware.entangled.data.memory import MemoryStore
from swarmnode.dependencies import Dependencies
from swarmnode.gateway import (
    FIRST_PICTURE_TIMEOUT_S,
    MAX_PHONES,
    PICTURE_BURST,
    PICTURE_TIMEOUT_S,
    Gateway,
    check_picture,
    derive_seed,
)
from swarmnode.simulated_team import SimulatedTeam
from tests.webnode.picture import jpeg
from webnode.errors import Refusal
from webnode.routes.phones import MAX_SIDE_PIXELS

STEP = 0.1
CAN = {"width": 208, "height": 156, "orientation": False, "position": True}


class Phone:
    """A phone at one gateway; it sends pictures as time passes."""

    def __init__(self, case: GatewayTests, at: Gateway, secret: bytes = b"s" * 32, name: str = "anna") -> None:
        self.case = case
        self.at = at
        self.said = ""
        self.fps = 0.0
        self.looks = True
        self.uuid: str = case.successResultOf(at.join(secret, name, CAN))
        case.phones.append(self)

    def look(self, values: Mapping[str, float]) -> None:
        wanted = self.at.receive_picture(self.uuid, jpeg(), values)
        self.said, self.fps = wanted.say, wanted.fps


class GatewayTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = SimulatedTeam(3, dogs=("dog1", "dog2"), others=("pi",))
        self.addCleanup(self.team.stop)
        self.phones: list[Phone] = []
        self.port = 7100
        self.gateways = {name: self.gateway(name) for name in ("vaio", "pi")}
        self.sees: Mapping[str, float] = {}

    def tearDown(self) -> None:
        for gateway in self.gateways.values():
            gateway.close()
        self.team.clock.advance(0.5)

    def gateway(self, name: str) -> Gateway:
        service = self.team.services[name]

        def seams() -> Dependencies:
            self.port += 1
            network = partial(self.team.switchboard.make_network, "127.0.0.1", self.port)
            store = MemoryStore(epoch=self.port.to_bytes(8, "big"))
            clock = self.team.clock
            return Dependencies(clock, network, store, random.Random(self.port), clock.seconds)

        control = self.team.control
        return Gateway(
            service.settings, service.assembly.node, seams, lambda: [d for d, _ in parse_devices(control.read(DEVICES))]
        )

    def live(self, seconds: float) -> None:
        """Advance the time; the phones send ten pictures per second."""
        for _ in range(round(seconds / STEP)):
            self.team.clock.advance(STEP)
            for phone in self.phones:
                if phone.looks:
                    phone.look(self.sees)

    def device(self, uuid: str) -> dict[str, object]:
        found = [each for each in self.team.state()["devices"] if each["uuid"] == uuid]
        return dict(found[0]) if found else {}

    def test_is_a_device_like_any_other(self) -> None:
        """A phone that joins is an idle device with its own address and position, and its pictures can be watched."""
        phone = Phone(self, self.gateways["vaio"])
        self.sees = {"position.lat": 52.123456789, "position.lon": 13.0, "position.accuracy": 12.4}
        self.live(1.5)
        device = self.device(phone.uuid)
        self.assertEqual((device["name"], device["kind"], device["status"]), ("anna", "phone", "IDLE"))
        self.assertEqual(sorted(device["capabilities"]), ["camera", "position"])  # type: ignore[call-overload]
        self.assertNotEqual(device["address"], self.device(self.team.services["vaio"].assembly.node.uuid)["address"])
        told = next(d for d, _ in parse_devices(self.team.control.read(DEVICES)) if d.uuid == phone.uuid)
        self.assertEqual(told.position, {"lat": 52.12346, "lon": 13.0, "accuracy": 12.0})
        self.assertEqual((phone.said, phone.fps), ("Nothing to do at the moment.", 5.0))
        seen: list[bytes] = []
        stop = self.team.control.stream_camera(phone.uuid, lambda seq, picture, age: seen.append(picture))
        self.live(1.0)
        stop()
        self.assertGreater(len(seen), 4)
        self.assertEqual(set(seen), {jpeg()})

    def test_wins_and_is_taken_over(self) -> None:
        """The nearest phone is assigned the task; when it leaves, a dog that sees the target takes over."""
        phone = Phone(self, self.gateways["vaio"])
        self.team.simulator.world.place_target(1.5, 1.2)
        self.sees = {"target.bearing": 0.0, "target.distance": 0.05}
        self.live(1.0)
        self.team.control.assign("watch-target")
        self.until(lambda: self.device(phone.uuid)["status"] == "EXECUTING", 40.0)
        self.assertEqual((phone.said, phone.fps), ("You have the task: keep the target in view.", 10.0))
        self.sees = {}
        self.live(0.3)
        self.assertIn("out of sight", phone.said)
        self.sees = {"target.bearing": 0.0, "target.distance": 0.05}
        self.until(self.dog_waits, 30.0)
        phone.at.leave(phone.uuid)
        self.phones.clear()
        began = self.team.clock.seconds()
        self.until(self.dog_acts, 2.0)
        self.assertLess(self.team.clock.seconds() - began, 1.0)
        self.until(lambda: self.team.state()["tasks"][0]["status"] == "COMPLETED", 60.0)

    def test_silence_is_leaving(self) -> None:
        """A phone that falls silent is removed, and a different device takes over its task within two seconds."""
        phone = Phone(self, self.gateways["vaio"])
        self.team.simulator.world.place_target(1.5, 1.2)
        self.sees = {"target.bearing": 0.0, "target.distance": 0.05}
        self.team.control.assign("watch-target")
        self.until(lambda: self.device(phone.uuid).get("status") == "EXECUTING" and self.dog_waits(), 40.0)
        phone.looks = False
        began = self.team.clock.seconds()
        self.until(self.dog_acts, 2.0)
        self.live(PICTURE_TIMEOUT_S)
        refusal = self.assertRaises(Refusal, phone.look, {})
        self.assertEqual(refusal.status, 404)
        self.assertLess(self.team.clock.seconds() - began, 2.0 + PICTURE_TIMEOUT_S)

    def test_first_look_may_take_longer(self) -> None:
        """The first picture may take up to ``FIRST_PICTURE_TIMEOUT_S``; a phone that falls silent later is removed."""
        phone = Phone(self, self.gateways["vaio"])
        phone.looks = False
        self.live(FIRST_PICTURE_TIMEOUT_S - 0.2)
        phone.look({})
        self.live(PICTURE_TIMEOUT_S + 0.2)
        self.assertEqual(self.assertRaises(Refusal, phone.look, {}).status, 404)

    def test_is_the_same_device_elsewhere(self) -> None:
        """If its web node fails, a phone joins through a different one, with the same uuid, position and name."""
        phone = Phone(self, self.gateways["vaio"])
        self.live(1.5)
        before = self.device(phone.uuid)
        # When the web node stops, the nodes of its phones stop too.
        lost = self.gateways.pop("vaio")
        for each in lost._phones.values():
            each._node.stop_silently()
            each._agent.stopService()
            assert each._timer is not None
            each._timer.cancel()
        self.phones.clear()
        again = Phone(self, self.gateways["pi"])
        self.assertEqual(again.uuid, phone.uuid)
        self.live(2.5)
        after = self.device(phone.uuid)
        for key in ("name", "joined", "status"):
            self.assertEqual(after[key], before[key])
        self.assertIsNone(after["gone"])
        names = [each["name"] for each in self.team.state()["devices"]]
        self.assertEqual(names.count("anna"), 1)

    def test_identity_is_of_team_and_phone(self) -> None:
        """The identity depends on the phone and on the team."""
        seeds = {derive_seed(team, phone) for team in (b"a" * 32, b"b" * 32) for phone in (b"1" * 32, b"2" * 32)}
        self.assertEqual(len(seeds), 4)
        self.assertEqual(derive_seed(b"a" * 32, b"1" * 32), derive_seed(b"a" * 32, b"1" * 32))

    def test_comes_back_while_it_leaves(self) -> None:
        """A phone that joins again while it is releasing its task waits until the release is done.

        The phone is listed only once.
        """
        phone = Phone(self, self.gateways["vaio"])
        self.sees = {"target.bearing": 0.0, "target.distance": 0.05}
        self.team.control.assign("watch-target")
        self.until(lambda: self.device(phone.uuid).get("status") == "EXECUTING", 40.0)
        phone.at.leave(phone.uuid)
        phone.at.leave(phone.uuid)
        self.phones.clear()
        came = [phone.at.join(b"s" * 32, "anna", CAN) for _ in range(2)]
        self.assertNoResult(came[0])
        self.team.clock.advance(0.3)
        self.assertEqual([self.successResultOf(each) for each in came], [phone.uuid] * 2)
        self.phones.append(phone)
        self.until(lambda: self.device(phone.uuid).get("status") == "EXECUTING", 40.0)

    def test_leaves_with_its_web_node(self) -> None:
        """A web node that stops removes its phones before the stop is complete."""
        phones = [Phone(self, self.gateways["vaio"], bytes([n]) * 32, f"p{n}") for n in (1, 2)]
        self.live(1.0)
        self.phones.clear()
        self.successResultOf(self.gateways["vaio"].close())
        self.team.clock.advance(0.3)
        told = [self.device(phone.uuid).get("status", "GONE") for phone in phones]
        self.assertEqual(told, ["GONE", "GONE"])

    def test_names_are_of_one_device_each(self) -> None:
        """A phone with the same name as another device gets a suffix; otherwise its name is unchanged."""
        first = Phone(self, self.gateways["vaio"], b"1" * 32, "dog1")
        second = Phone(self, self.gateways["vaio"], b"2" * 32, "anna")
        third = Phone(self, self.gateways["vaio"], b"3" * 32, "anna")
        self.live(1.5)
        told = [self.device(each.uuid)["name"] for each in (first, second, third)]
        self.assertEqual(told, [f"dog1-{first.uuid[:4]}", "anna", f"anna-{third.uuid[:4]}"])

    def test_takes_so_many(self) -> None:
        """Beyond ``MAX_PHONES`` a phone is rejected until another phone leaves; a connected phone may join again."""
        gateway = self.gateways["vaio"]
        phones = [Phone(self, gateway, bytes([n]) * 32, f"p{n}") for n in range(MAX_PHONES)]
        refusal = self.failureResultOf(gateway.join(b"x" * 32, "late", CAN), Refusal).value
        self.assertEqual(refusal.status, 409)
        self.assertEqual(self.successResultOf(gateway.join(bytes([0]) * 32, "p0", CAN)), phones[0].uuid)
        gateway.leave(phones[0].uuid)
        self.assertEqual(self.failureResultOf(gateway.join(b"x" * 32, "late", CAN), Refusal).value.status, 429)
        self.phones.pop(0)
        self.live(2.0)
        self.assertTrue(self.successResultOf(gateway.join(b"x" * 32, "late", CAN)))

    def test_sent_away_stays_away(self) -> None:
        """A phone that an operator disconnects for some time cannot join again before the end of that time."""
        phone = Phone(self, self.gateways["vaio"])
        self.live(1.0)
        self.team.control.disconnect(phone.uuid, 3.0)
        self.phones.clear()
        self.live(0.5)
        refusal = self.failureResultOf(phone.at.join(b"s" * 32, "anna", CAN), Refusal).value
        self.assertEqual((refusal.status, refusal.problem), (409, "an operator removed this phone"))
        self.live(3.0)
        self.successResultOf(phone.at.join(b"s" * 32, "anna", CAN))

    def test_refuses_what_is_no_look(self) -> None:
        """An invalid or too large picture, too many pictures, and pictures of an unknown phone are rejected."""
        phone = Phone(self, self.gateways["vaio"])
        self.assertEqual(check_picture(jpeg(MAX_SIDE_PIXELS, 10)), (MAX_SIDE_PIXELS, 10))
        for body in (
            b"",
            b"GIF89a",
            jpeg()[:-2],
            jpeg(MAX_SIDE_PIXELS + 1, 10),
            jpeg(10, MAX_SIDE_PIXELS + 1),
            jpeg(0, 10),
        ):
            refusal = self.assertRaises(Refusal, phone.at.receive_picture, phone.uuid, body, {})
            self.assertEqual(
                (refusal.status, refusal.remedy),
                (400, f"send a complete JPEG of at most {MAX_SIDE_PIXELS} pixels a side"),
            )
        self.assertEqual(self.assertRaises(Refusal, phone.at.receive_picture, "0" * 40, jpeg(), {}).status, 404)
        for _ in range(round(PICTURE_BURST)):
            phone.look({})
        self.assertEqual(self.assertRaises(Refusal, phone.look, {}).status, 429)
        self.team.clock.advance(STEP)
        phone.look({})

    def test_says_that_the_team_stands(self) -> None:
        """While the team is stopped, the phone's page reports it."""
        phone = Phone(self, self.gateways["vaio"])
        self.live(1.0)
        node = self.team.services["vaio"].assembly.node
        node.stop_state.stop("test", node.entangled.overlay.contacts())
        self.live(0.5)
        self.assertEqual(phone.said, "The team is stopped. Wait.")

    def until(self, is_so: object, limit: float) -> None:
        """Advance the time until a condition is true."""
        assert callable(is_so)
        for _ in range(round(limit / STEP)):
            if is_so():
                return
            self.live(STEP)
        self.fail(str([(d["name"], d["status"], d["messages"]) for d in self.team.state()["devices"]]))

    def dog_waits(self) -> bool:
        return "WAITING" in self.dogs()

    def dog_acts(self) -> bool:
        return "EXECUTING" in self.dogs()

    def dogs(self) -> list[str]:
        return [each["status"] for each in self.team.state()["devices"] if each["name"].startswith("dog")]
