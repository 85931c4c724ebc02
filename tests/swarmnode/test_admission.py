"""Tests of the verbs that create, join and leave a closed team, with a node of a simulated team."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import operator as operators
from middleware.admission.join_client import JoinClient
from middleware.admission.join_code import JoinCode
from middleware.admission.membership_file import Membership, MembershipFile, MemoryMembership
from middleware.config.settings import Settings
from middleware.entangled.errors import EntangledError, NoAnswer
from middleware.entangled.network.network import Address
from middleware.errors import BadSetting
from swarmnode.assembly import assemble_node
from swarmnode.simulated_team import SimulatedTeam
from swarmnode.team import init, invitations, invite, join, members, promote, renew, revoke, rotate
from swarmnode.team.common import CommandContext
from tests.swarmnode.shell import Shell, runtime_folder
from tests.swarmnode.team import KEY, MemoryTeam

Main = Callable[[Sequence[str], CommandContext], int]


class AdmissionTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.folder = runtime_folder(self)
        self.team = SimulatedTeam(21, dogs=("dog1",))
        self.addCleanup(self.team.stop)
        self.laptop = self.team.services["vaio"].assembly.node
        self.shell = Shell(self.team, self.laptop)
        self.key = self.folder / "key"
        operators.create_operator_file(self.key, self.team.operator)
        home = {"XDG_CONFIG_HOME": str(self.folder / "config"), "SWARM_OPERATOR": str(self.key)}
        self.patch(os, "environ", {**os.environ, **home})
        self.dice = random.Random(1)
        self.said = ""
        self.newcomers = 0

    def run_verb(self, main: Callable[..., int], *words: str, **more: Any) -> tuple[int, str]:
        """Run a verb; return exit code and output, and store the error output in ``said``."""
        out, complaint = io.StringIO(), io.StringIO()
        context = CommandContext(out, self.shell.ask, self.team.clock.seconds, self.dice)
        with contextlib.redirect_stderr(complaint):
            code = main(list(words), context, **more)
        self.said = complaint.getvalue()
        return code, out.getvalue()

    def done(self, main: Callable[..., int], *words: str, **more: Any) -> Any:
        """Run a verb, which must succeed; return its result."""
        code, output = self.run_verb(main, *words, "--json", **more)
        self.assertEqual(code, 0, self.said)
        return json.loads(output)

    def knock(self, code: JoinCode, seed: bytes, wish: str, addresses: Sequence[Address], timeout: float) -> Membership:
        """Send the join request of ``swarm join`` in the virtual time and network of the team."""
        self.newcomers += 1
        network = self.team.switchboard.make_network("127.0.0.1", 9000 + self.newcomers)
        work = JoinClient(code, seed, network, self.team.clock, self.dice, wish).join(addresses, timeout)
        outcome: list[Any] = []
        work.addCallbacks(outcome.append, lambda failure: outcome.append(failure.value))
        self.team.clock.advance(timeout + 0.1)
        if isinstance(outcome[0], EntangledError):
            raise outcome[0]
        found: Membership = outcome[0]
        return found

    def joined(self, text: str, folder: str = "new", **more: Any) -> Any:
        return self.done(join.main, text, "--folder", str(self.folder / folder), send_requests=self.knock, **more)

    def names(self) -> list[str]:
        return [each["name"] for each in self.done(members.main)["members"]]

    def test_init_makes_a_team(self) -> None:
        """``swarm init`` creates a key, a membership and valid settings; a second run is rejected."""
        where = self.folder / "made"
        words = ("yard", "--operator", str(self.folder / "yard"), "--folder", str(where), "--at", "127.0.0.1:7000")
        found = self.done(init.main, *words, "--set", "presence_lease=2.5")
        settings = Settings.load(found["settings"])
        kept = MembershipFile(Path(settings.node.membership))
        self.assertEqual(kept.membership.operator, operators.load_operator(Path(found["operator"])).public)
        self.assertEqual((settings.node.presence_lease, settings.node.port), (2.5, 7000))
        self.assertEqual(dict(kept.membership.settings), {"presence_lease": 2.5})
        self.assertEqual(Path(found["operator"]).stat().st_mode & 0o777, 0o600)
        self.assertEqual(self.run_verb(init.main, *words)[0], 2)
        self.assertIn("exists already", self.said)

    def test_init_with_options(self) -> None:
        """By default the first node listens on all interfaces.

        ``--page`` enables the node's page, and ``--member`` adds a member to the team.
        """
        words = ("yard", "--operator", str(self.folder / "yard"), "--folder", str(self.folder), "--first", "vaio")
        for twice in (("--member", "vaio"), ("--member", "dog1", "--member", "dog1=gateway")):
            self.assertEqual(self.run_verb(init.main, *words, *twice)[0], 2)
            self.assertIn(f"--member {twice[-1]}: another member has this name", self.said)
        settings = Settings.load(self.done(init.main, *words, "--page")["settings"])
        self.assertEqual((settings.node.host, settings.node.port), ("*", 8484))
        self.assertIn("web", settings.node.roles)
        self.assertEqual(settings.web.host, "0.0.0.0")
        others = ("yard", "--operator", str(self.folder / "other"), "--folder", str(self.folder / "other-team"))
        self.done(init.main, *others, "--at", "192.0.2.7:8484", "--member", "mine=operator,gateway")
        node = Settings.load(str(self.folder / "other-team" / "mine.toml")).node
        self.assertEqual((node.host, node.known_nodes), ("*", (Address("192.0.2.7", 8484),)))
        self.assertEqual(MembershipFile(Path(node.membership)).membership.member.roles, ("operator", "gateway"))

    def test_newcomer_hears_more_than_its_own_machine(self) -> None:
        """A node that joins through another machine listens on all interfaces, other nodes on the loopback address."""
        found = self.done(invite.main, "dog9")

        def elsewhere(*knock: Any) -> Membership:
            return replace(self.knock(*knock), known_nodes=(Address("192.0.2.7", 7000),))

        words = (found["text"], "--folder", str(self.folder / "far"))
        settings = Settings.load(self.done(join.main, *words, send_requests=elsewhere)["settings"])
        self.assertEqual(settings.node.host, "*")
        near = self.joined(self.done(invite.main, "dog8")["text"], "near")
        self.assertEqual(Settings.load(near["settings"]).node.host, "127.0.0.1")

    def test_invite_and_join(self) -> None:
        """With an invitation from the laptop a node joins, and the verb writes files with which the node starts."""
        code, output = self.run_verb(invite.main, "dog9")
        self.assertEqual(code, 0, self.said)
        self.assertIn("admits dog9, once, within 24 h", output)
        self.assertGreater(sum("█" in line or "▀" in line or "▄" in line for line in output.splitlines()), 10)
        text = output.partition("swarm join ")[2].split()[0]
        self.assertTrue(text.endswith("@127.0.0.1:7000"))
        found = self.joined(text)
        settings = Settings.load(found["settings"])
        self.assertEqual((found["name"], settings.node.name, found["roles"]), ("dog9", "dog9", ["device"]))
        self.assertEqual(self.names(), ["dog1", "dog9", "vaio"])
        team = MemoryTeam()
        dependencies = team.make_dependencies("dog9", 7099)
        kept = MembershipFile(Path(settings.node.membership))
        made_node = assemble_node(settings, type(dependencies)(**{**dependencies.__dict__, "membership": kept})).node
        self.assertEqual(made_node.entangled.identity, kept.membership.identity)

    def test_killed_while_joining(self) -> None:
        """A node killed after its admission can join again with the same code, which is used up only once."""
        found = self.done(invite.main, "dog9")
        words = (found["text"], "--folder", str(self.folder / "new"))

        def killed(*knock: Any) -> Membership:
            self.knock(*knock)
            raise SystemExit(1)

        with self.assertRaises(SystemExit):
            self.run_verb(join.main, *words, send_requests=killed)
        self.assertEqual([path.stat().st_mode & 0o777 for path in (self.folder / "new").iterdir()], [0o600])
        self.assertEqual(self.done(join.main, *words, send_requests=self.knock)["name"], "dog9")
        self.assertEqual(self.names(), ["dog1", "dog9", "vaio"])
        left = sorted(path.name for path in (self.folder / "new").iterdir())
        self.assertEqual(left, ["swarm.membership", "swarm.toml"])
        other = self.done(invite.main, "dog8")["text"]
        self.assertEqual(self.joined(other, "more")["name"], "dog8")

    def test_place_of_a_member(self) -> None:
        """The location of a member is described in words if the address is unknown, or that of a tunnel or a relay."""
        places = {"10.0.0.7:8484": "10.0.0.7:8484", "": "no known address", "~wss-1fa56333f510:1": "by a tunnel"}
        for address, words in {**places, f"~{'ab' * 20}:1": "by a relay"}.items():
            self.assertEqual(members.format_location(address), words)

    def test_settings_that_were_there(self) -> None:
        """Existing settings are kept and reported; settings that ``swarm join`` created are not reported."""
        where = self.folder / "new"
        where.mkdir()
        (where / "swarm.toml").write_text('[node]\nname = "mine"\n')
        text = self.done(invite.main, "dog9")["text"]
        _, output = self.run_verb(join.main, text, "--folder", str(where), send_requests=self.knock)
        self.assertIn("existed and was not changed", output)
        self.assertEqual((where / "swarm.toml").read_text(), '[node]\nname = "mine"\n')
        text = self.done(invite.main, "dog8")["text"]
        _, output = self.run_verb(join.main, text, "--folder", str(self.folder / "other"), send_requests=self.knock)
        self.assertNotIn("existed and was not changed", output)

    def test_key_of_another_code_is_not_used(self) -> None:
        """A repeated join with the same code uses the same key; a join with a different code creates a new key."""
        seeds: list[bytes] = []
        first, other = (self.done(invite.main, name)["text"] for name in ("dog8", "dog9"))

        def silent(code: JoinCode, seed: bytes, *rest: Any) -> Membership:
            seeds.append(seed)
            raise NoAnswer("nobody opens")

        for text in (first, first, other):
            words = (text, "--folder", str(self.folder / "new"))
            self.assertEqual(self.run_verb(join.main, *words, send_requests=silent)[0], 1)
        self.assertEqual((seeds[0], len(set(seeds))), (seeds[1], 2))

    def test_bad_codes_are_named(self) -> None:
        """A mistyped code is rejected before a request is sent; a used code is rejected by the bootstrap node.

        Both errors contain a remedy.
        """
        found = self.done(invite.main, "dog9")
        wrong = found["code"][:-1] + ("0" if found["code"][-1] != "0" else "1")
        self.assertEqual(self.run_verb(join.main, wrong, "--at", "127.0.0.1:7000", send_requests=self.knock)[0], 2)
        self.assertIn("mistyped", self.said)
        self.assertEqual(self.newcomers, 0)
        self.joined(found["text"])
        words = (found["text"], "--folder", str(self.folder / "other"))
        self.assertEqual(self.run_verb(join.main, *words, send_requests=self.knock)[0], 1)
        self.assertIn("was used as often as it may be; ask the operator", self.said)
        self.assertEqual(self.run_verb(join.main, found["code"], send_requests=self.knock, find_nodes=lambda: [])[0], 2)
        self.assertIn("--at HOST:PORT", self.said)

    def test_code_alone(self) -> None:
        """A code without an address is tried on the LAN.

        A node that is already a member does not use up its new code.
        """
        code = self.done(invite.main, "dog8")["code"]
        around = [Address("127.0.0.1", 7077), Address("127.0.0.1", 7000)]
        self.assertEqual(self.joined(code, find_nodes=lambda: around)["name"], "dog8")
        text = self.done(invite.main, "dog9")["text"]
        send_requests = self.newcomers
        code, _ = self.run_verb(join.main, text, "--folder", str(self.folder / "new"), send_requests=self.knock)
        self.assertEqual((code, self.newcomers), (2, send_requests))
        self.assertIn("is a member", self.said)
        self.assertEqual(self.run_verb(invite.main, "dog1")[0], 1)
        self.assertIn("the team already has a member dog1", self.said)

    def test_revoke(self) -> None:
        """A revoked member is removed from the list; the error for an unknown name lists the known names."""
        self.joined(self.done(invite.main, "dog9")["text"])
        self.assertEqual(self.run_verb(revoke.main, "dgo9")[0], 1)
        self.assertIn("members: dog1, dog9, vaio", self.said)
        self.assertEqual(self.done(revoke.main, "dog9")["what"], "the member")
        self.assertEqual(self.names(), ["dog1", "vaio"])
        self.assertEqual([each["name"] for each in self.done(members.main)["revoked"]], ["dog9"])

    def test_invitations_are_listed(self) -> None:
        """Valid invitations are listed with their remaining uses; ``--all`` also lists invalid invitations."""
        text = self.done(invite.main, "dog8", "--uses", "2", "--role", "viewer")["text"]
        self.done(invite.main, "dog9")
        name = self.joined(text)["name"]
        told = self.done(invitations.main)["invitations"]
        rows = [(row["name"], row["roles"], row["uses"], row["left"], row["state"], row["came"]) for row in told]
        self.assertEqual(
            sorted(rows),
            [("dog8", ["viewer"], 2, 1, "open", [name]), ("dog9", ["device"], 1, 1, "open", [])],
        )
        self.done(revoke.main, "dog9", "--invitation")
        self.assertEqual([row["name"] for row in self.done(invitations.main)["invitations"]], ["dog8"])
        told = {row["name"]: row["state"] for row in self.done(invitations.main, "--all")["invitations"]}
        self.assertEqual(told, {"dog8": "open", "dog9": "revoked"})
        self.assertIn("dog8", self.run_verb(invitations.main)[1])

    def test_revoke_invitation(self) -> None:
        """Revoking an invitation revokes all members that joined with it; the output lists these members."""
        text = self.done(invite.main, "pupil", "--uses", "3")["text"]
        self.joined(text)
        found = self.done(revoke.main, "pupil")
        self.assertEqual((found["what"], found["with"]), ("the invitation", ["pupil-1"]))
        self.assertEqual(self.names(), ["dog1", "vaio"])

    def test_rotate(self) -> None:
        """A rotation gives each member the new secret."""
        self.assertEqual(self.done(rotate.main, "--grace", "1h")["members"], ["dog1", "vaio"])
        self.team.clock.advance(2.0)
        numbers = {name: kept.membership.secrets[0][0] for name, kept in self.team._memberships.items()}
        self.assertEqual(numbers, {"vaio": 2, "dog1": 2})

    def test_promote(self) -> None:
        """A promoted member has its new role and lifetime immediately; a member with a fixed end keeps that end."""
        self.team.clock.advance(100.0)
        ends = {row["name"]: row for row in self.done(members.main)["members"]}
        self.assertEqual(self.done(promote.main, "dog1")["roles"], ["device", "bootstrap"])
        self.team.clock.advance(2.0)
        dog = self.team.services["dog1"].assembly.node.team
        assert dog is not None
        self.assertEqual(dog.admission.me.roles, ("device", "bootstrap"))
        promoted = {row["name"]: row for row in self.done(members.main)["members"]}
        self.assertTrue(promoted["dog1"]["renews"])
        self.assertGreaterEqual(promoted["dog1"]["until"], ends["dog1"]["until"] + 100)
        self.done(renew.main, "dog1", "--for", "1h")
        self.done(promote.main, "dog1", "--role", "viewer")
        self.team.clock.advance(2.0)
        row = next(row for row in self.done(members.main)["members"] if row["name"] == "dog1")
        self.assertFalse(row["renews"])
        self.assertLess(row["until"], self.team.clock.seconds() + 3600.0)

    def test_renew_who_has_expired(self) -> None:
        """A member with an expired certificate is listed as expired; a renewal makes it a member again."""
        self.done(renew.main, "dog1", "--for", "60s")
        self.team.clock.advance(70.0)
        shown = self.done(members.main)
        self.assertEqual(([row["name"] for row in shown["members"]], shown["expired"][0]["name"]), (["vaio"], "dog1"))
        self.assertIn("swarm renew dog1", self.run_verb(members.main)[1])
        renewed = self.done(renew.main, "dog1")
        self.team.clock.advance(15.0)
        found = self.done(members.main)
        self.assertEqual((renewed["roles"], renewed["renews"], found["expired"]), (["device"], True, []))
        dog = next(row for row in found["members"] if row["name"] == "dog1")
        self.assertEqual((dog["key"], bool(dog["at"])), (shown["expired"][0]["key"], True))
        self.done(revoke.main, "dog1")
        self.assertEqual(self.run_verb(renew.main, "dog1")[0], 1)

    def renewer_after(self, *words: str) -> bytes:
        """Revoke the bootstrap node that renewed the laptop's certificate; return the renewer of that certificate."""
        dog, laptop = self.team.services["dog1"].assembly.node.team, self.laptop.team
        assert dog is not None and laptop is not None
        self.done(promote.main, "dog1")
        self.team.clock.advance(50.0)
        self.assertTrue(dog._renewer.renew(laptop.admission.me, self.team.clock.seconds()))
        self.team.clock.advance(2.0)
        self.assertEqual(laptop.admission.me.renewer, dog.identity.public)
        self.done(revoke.main, "dog1", *words)
        self.team.clock.advance(2.0)
        self.assertIn("vaio", self.names())
        return laptop.admission.me.renewer

    def test_revoke_keeps_renewals(self) -> None:
        """Renewals that a revoked node signed for present members stay valid."""
        self.assertNotEqual(self.renewer_after(), b"")

    def test_revoke_with_all_renewals(self) -> None:
        """With ``--all`` the renewals that a revoked node signed become invalid."""
        self.assertEqual(self.renewer_after("--all"), b"")

    def test_keys_of_others(self) -> None:
        """A key of a different team, a key that other users can read, and a missing key are rejected with a remedy."""
        other = self.folder / "other"
        operators.create_operator_file(other, operators.create_operator("other", random.Random(2)))
        self.assertEqual(self.run_verb(invite.main, "dog9", "--operator", str(other))[0], 1)
        self.assertIn("another operator", self.said)
        self.key.chmod(0o644)
        self.assertEqual(self.run_verb(invite.main, "dog9")[0], 2)
        self.assertIn("chmod 600", self.said)
        self.patch(os, "environ", {**os.environ, "SWARM_OPERATOR": ""})
        self.assertEqual(self.run_verb(invite.main, "dog9")[0], 2)
        self.assertIn("swarm init", self.said)

    def test_node_takes_statements_only(self) -> None:
        """The control socket accepts a statement only with the signature of the team's operator."""
        strange = operators.create_operator("other", random.Random(2)).revoke(
            b"r" * 32, "dog1", self.team.clock.seconds()
        )
        told = {"statement": {"base64": base64.b64encode(strange).decode()}}
        [line] = self.shell.ask(self.folder, {"verb": "team tell", "with": told})
        self.assertIn("sign with the key of the team", line["text"])


class TeamSettingsTests(SynchronousTestCase):
    def refusal(self, **node: str) -> str:
        settings = Settings.from_mapping({"node": {"name": "a", **node}}, "a.toml")
        return str(self.assertRaises(BadSetting, assemble_node, settings, MemoryTeam().make_dependencies("a", 7000)))

    def test_neither_and_both(self) -> None:
        """A node without a team is rejected with a hint to ``swarm join``.

        A node with two teams is rejected as well.
        """
        self.assertIn("swarm join CODE", self.refusal())
        self.assertIn("closed or open", self.refusal(team_key=KEY, membership="m"))

    def test_membership_opens_the_door(self) -> None:
        """A membership determines the node's identity and certificate; no team key is needed."""
        dice = random.Random(1)
        membership = operators.create_operator("yard", dice).create_membership("a", ("device",), 0, dice)
        dependencies = MemoryTeam().make_dependencies("a", 7000)
        dependencies = type(dependencies)(**{**dependencies.__dict__, "membership": MemoryMembership(membership)})
        node = assemble_node(Settings.from_mapping({"node": {"name": "a"}}, "a.toml"), dependencies).node
        self.assertEqual(node.entangled.identity, membership.identity)
        self.assertEqual(node.entangled.endpoint.admission.own_pass, membership.certificate)
