"""Attack S12: read keys from files that are readable by other users, from logs, or from a node's answers."""

from __future__ import annotations

import base64
import os
import random
import stat
from pathlib import Path
from typing import Any

from twisted.logger import formatEvent

from middleware.admission import keyfile, membership_file, operator
from middleware.admission.errors import BadKeyFile
from middleware.admission.membership_file import Membership, MembershipFile
from middleware.admission.operator import Operator
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.identity import Identity
from tests.attacks.siege import SOURCE, SiegeCase, events_of
from tests.middleware.admission.paper import NOW
from tests.middleware.admission.paper import operator as drawn


class FileTests(SiegeCase):
    def setUp(self) -> None:
        """Write a membership and an operator's key, each to a file."""
        super().setUp()
        self.folder = Path(self.mktemp())
        self.folder.mkdir()
        self.signer: Operator = drawn(1)
        self.paper: Membership = self.signer.create_membership("vaio", ("device",), NOW, random.Random(1))
        self.files = {self.folder / "membership": MembershipFile, self.folder / "operator": operator.load_operator}
        membership_file.create_membership_file(self.folder / "membership", self.paper)
        operator.create_operator_file(self.folder / "operator", self.signer)

    def test_made_for_the_owner_alone(self) -> None:
        """New and replaced key files, and the files of the store, have mode 0600 under any umask."""
        before = os.umask(0)
        self.addCleanup(os.umask, before)
        membership_file.create_membership_file(self.folder / "other", self.paper)
        found = MembershipFile(self.folder / "other")
        found.save(self.paper.with_secret(2, bytes(32), 0))
        store = SqliteStore.open(self.folder / "store.db", 0.0)
        store.set_note("x", b"y")
        store.close()
        for path in (*self.files, self.folder / "other", *self.folder.glob("store.db*")):
            self.assertEqual(stat.S_IMODE(path.stat().st_mode), 0o600, path)

    def test_readable_by_others(self) -> None:
        """A key file that other users may access in any way is rejected, and the error states the remedy."""
        for path, load in self.files.items():
            for mode in (0o640, 0o604, 0o660, 0o606, 0o620, 0o602, 0o601, 0o610, 0o777):
                path.chmod(mode)
                error = self.assertRaises(BadKeyFile, load, path)
                self.assertIn(f"chmod 600 {path}", str(error))
            path.chmod(0o600)
            load(path)

    def test_no_file_at_all(self) -> None:
        """A folder, a dangling link and a file with invalid content are rejected; the error contains no content."""
        (self.folder / "dir").mkdir()
        (self.folder / "nowhere").symlink_to(self.folder / "gone")
        (self.folder / "rubbish").write_bytes(b'{"seed": "topsecretseed"')
        (self.folder / "rubbish").chmod(0o600)
        for name in ("dir", "nowhere", "rubbish", "gone"):
            for load in self.files.values():
                error = self.assertRaises(BadKeyFile, load, self.folder / name)
                self.assertNotIn("topsecretseed", str(error))

    def test_one_for_the_other(self) -> None:
        """An operator's key file is rejected as a membership file, and a membership file as an operator's key file."""
        self.assertRaises(BadKeyFile, MembershipFile, self.folder / "operator")
        self.assertRaises(BadKeyFile, operator.load_operator, self.folder / "membership")

    def test_a_member_has_no_operators_key(self) -> None:
        """A member's file does not contain the operator's secret."""
        self.assertNotIn(self.signer.seed.hex(), (self.folder / "membership").read_text())
        self.assertNotIn(self.signer.seed.hex(), str(keyfile.read(self.folder / "membership")))


class SaidTests(SiegeCase):
    def setUp(self) -> None:
        """Record all log events with their fields."""
        super().setUp()
        self.events = events_of(self)

    def secrets(self, team: Any) -> list[str]:
        """Return every secret of a team, in all forms that a log line could contain."""
        raw = [team.signer.seed]
        for house in team.houses:
            kept = house.kept.membership
            raw += [kept.seed, kept.identity.exchange_secret, *(secret for _, secret, _ in kept.secrets)]
        return [form for each in raw for form in (each.hex(), repr(each)[2:-1], base64.b64encode(each).decode()[:-1])]

    def test_nothing_in_logs(self) -> None:
        """No log line contains a secret or code while a team joins, invites, admits, rejects, revokes and rotates."""
        team = self.village()
        dog = team.welcome("dog")
        code = team.invite("cat")
        team.knock(code, timeout=3.0).addErrback(lambda failure: None)
        team.knock(code, timeout=3.0).addErrback(lambda failure: None)
        team.run(4.0)
        stranger = self.attacker(team, Identity(b"x" * 32), dog.team.secret, b"", SOURCE)
        stranger.ask(team.contact(dog), "ping", bytes(8), changes=True).addErrback(lambda failure: None)
        team.run(2.0)
        team.tell(team.signer.revoke(dog.public, "dog", team.wall()))
        team.tell(team.signer.rotate_secret(2, [team.houses[0].public], team.wall(), 5.0, team.dice))
        team.run(10.0)
        team.close(team.houses[0])
        team.open(team.houses[0])
        team.run(5.0)
        fields = [f"{value!r} {value}" for each in self.events for name, value in each.items() if name != "log_logger"]
        text = "\n".join([*map(formatEvent, self.events), *fields])
        self.assertGreater(len(self.events), 10)
        self.assertIn("revoked", text)
        self.assertEqual([each for each in (*self.secrets(team), code) if each in text], [])

    def test_nothing_in_representations(self) -> None:
        """The ``repr`` of an identity, a membership, an operator and a join reply contains no secret."""
        team = self.village()
        house = team.houses[0]
        shown = [
            *(repr(each) + str(each) for each in (house.kept.membership, house.kept, team.signer, house.team)),
            repr(house.kept.membership.identity) + str(house.kept.membership.identity),
            repr(house.node.endpoint) + repr(house.team.admission) + repr(house.team.membership_list),
            repr(house.node.endpoint._credentials),
            repr(house.team._build_reply(house.kept.membership.certificate)),
        ]
        self.assertEqual([each for each in self.secrets(team) if each in "\n".join(shown)], [])

    def test_nothing_is_told_to_members(self) -> None:
        """No answer that any member can request contains another member's seed or the operator's key."""
        team = self.village()
        team.enlist("dog")
        bare, _ = self.insider(team, "eye", "viewer")
        contact = team.contact(team.houses[0])
        answers = []
        for method, arguments in (
            ("roll.compare", (bytes(8),)),
            ("roll.fetch", (team.houses[0].team.membership_list.digests,)),
            ("known", ()),
            ("members", (b"",)),
            ("find_node", (bytes(20),)),
        ):
            answers.append(repr(self.outcome(team, bare.ask(contact, method, *arguments))))
        text = "\n".join(answers)
        self.assertGreater(len(text), 300)
        seeds = [house.kept.membership.seed for house in team.houses] + [team.signer.seed]
        forms = [form for each in seeds for form in (each.hex(), repr(each)[2:-1])]
        self.assertEqual([each for each in forms if each in text], [])
