"""Tests of ``webnode.routes.session``: signing in over the API."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.identity import Identity
from tests.webnode.memory import MemoryInvites, MemoryTeamControl
from webnode.app import create_app
from webnode.audit import AuditLog
from webnode.failover import Fallbacks, Page
from webnode.password import hash_password, verify_password
from webnode.services import Services
from webnode.session import SignedSessions
from webnode.state import format_state
from webnode.token import MAX_TEXT, TokenKey


class SessionRouteTests(SynchronousTestCase):
    def setUp(self) -> None:
        check: Any = lambda text, word: succeed(verify_password(text, word))  # noqa: E731
        password = hash_password("correct horse", bytes(16), 4)
        sessions = SignedSessions(
            TokenKey(Identity(bytes(32))), lambda _: True, "quiet-otter", password, random.Random(1), check
        )
        self.audit = AuditLog()
        state = format_state([], [], {}, node="vaio")
        self.services = Services(MemoryTeamControl(), sessions, self.audit)
        self.client = create_app(lambda: state, self.services, wall=lambda: 1000.0).test_client()

    def signed(self, **body: str) -> dict[str, Any]:
        answer = self.client.post("/api/v1/session", json=body)
        self.assertEqual(answer.status_code, 200, answer.get_json())
        return dict(answer.get_json())

    def bearer(self, token: str) -> dict[str, str]:
        return {"Authorization": f"Bearer {token}"}

    def test_sign_in_and_out(self) -> None:
        """Code and password sign in.

        The token permits changes, the ticket reads; after signing out neither is valid.
        """
        for body in ({"code": "quiet-otter"}, {"password": "correct horse"}):
            told = self.signed(**body)
            self.assertEqual((told["role"], told["until"]), ("operator", 1000.0 + 12 * 3600))
            bearer = self.bearer(told["token"])
            self.assertEqual(self.client.get("/api/v1/session", headers=bearer).get_json()["role"], "operator")
            self.assertEqual(self.client.post("/api/v1/demo", json={}, headers=bearer).status_code, 202)
            ticket = f"ticket={told['ticket']}"
            self.assertEqual(self.client.get(f"/api/v1/state?{ticket}").status_code, 200)
            self.assertEqual(self.client.post(f"/api/v1/demo?{ticket}", json={}).status_code, 403)
            self.assertEqual(self.client.delete("/api/v1/session", headers={**bearer, "X-Swarm": "1"}).status_code, 200)
            self.assertEqual(self.client.post("/api/v1/demo", json={}, headers=bearer).status_code, 401)
            self.assertEqual(self.client.get(f"/api/v1/state?{ticket}").status_code, 401)

    def test_renew(self) -> None:
        """A token renews its session; signing out with the old token also ends the renewed session."""
        told = self.signed(code="quiet-otter")
        bearer = {**self.bearer(told["token"]), "X-Swarm": "1"}
        anew = self.client.put("/api/v1/session", headers=bearer)
        self.assertEqual((anew.status_code, anew.get_json()["role"]), (200, "operator"))
        for wrong in ({"X-Swarm": "1"}, {**self.bearer(told["ticket"]), "X-Swarm": "1"}):
            self.assertEqual(self.client.put("/api/v1/session", headers=wrong).status_code, 401)
        self.client.delete("/api/v1/session", headers=bearer)
        headers = self.bearer(anew.get_json()["token"])
        self.assertEqual(self.client.get("/api/v1/session", headers=headers).get_json()["role"], "anyone")

    def test_go_on_elsewhere(self) -> None:
        """A session receives a token for each other web node by uuid, but none for this node.

        A ticket receives none.
        """
        told = self.signed(code="quiet-otter")
        other = "ab" * 20
        self.services.fallbacks = Fallbacks(Page("here", "http://10.0.0.7:80", is_self=True), Page(other, "http://x"))
        given = self.client.get("/api/v1/session/passes", headers=self.bearer(told["token"])).get_json()
        self.assertEqual(list(given), [other])
        self.assertEqual((given[other]["role"], given[other]["until"]), ("operator", 1600.0))
        here = self.client.get("/api/v1/session", headers=self.bearer(given[other]["token"])).get_json()
        self.assertEqual(here["role"], "anyone")
        for headers in ({}, self.bearer(told["ticket"])):
            self.assertEqual(self.client.get("/api/v1/session/passes", headers=headers).status_code, 401)

    def test_refuse_bad_words(self) -> None:
        """No proof, two proofs and a wrong proof are rejected; no response and no audit line contains the proof."""
        for body, status in (
            ({}, 400),
            ({"code": "quiet-otter", "password": "correct horse"}, 400),
            ({"code": "s3cr3t-guess"}, 401),
            ({"password": "s3cr3t-guess"}, 401),
            ({"code": 7}, 400),
            ({"code": "x" * (MAX_TEXT + 1)}, 400),
        ):
            answer = self.client.post("/api/v1/session", json=body)
            self.assertEqual(answer.status_code, status, body)
            self.assertNotIn("s3cr3t", answer.get_data(as_text=True))
        self.assertNotIn("s3cr3t", str(self.audit.list_newest(100)))
        self.assertIn("401", str(self.audit.list_newest(100)))

    def test_answer_each_user_for_itself(self) -> None:
        """Two users with the same idempotency key get separate responses."""
        key = {"Idempotency-Key": "1"}
        first = self.client.post("/api/v1/session", json={"code": "quiet-otter"}, headers=key)
        second = self.client.post("/api/v1/session", json={"code": "a wrong one"}, headers=key)
        self.assertEqual((first.status_code, second.status_code), (200, 401))

    def test_invite(self) -> None:
        """An operator's invitation signs in a viewer, which cannot invite users itself, until the invitation ends."""
        bearer = self.bearer(self.signed(code="quiet-otter")["token"])
        body = {"role": "viewer", "name": "Ada", "seconds": 60}
        invited = self.client.post("/api/v1/invitations", json=body, headers=bearer).get_json()
        self.assertEqual((invited["role"], invited["until"]), ("viewer", 1060.0))
        told = self.signed(code=invited["token"])
        viewer = self.bearer(told["token"])
        self.assertEqual(
            self.client.get("/api/v1/session", headers=viewer).get_json(), {"name": "Ada", "role": "viewer"}
        )
        self.assertEqual(self.client.post("/api/v1/invitations", json=body, headers=viewer).status_code, 403)
        for wrong in ({"role": "anyone"}, {"role": "viewer", "seconds": 0}, {}):
            self.assertEqual(self.client.post("/api/v1/invitations", json=wrong, headers=bearer).status_code, 400)

    def test_invite_by_a_link(self) -> None:
        """An invitation contains a link to the best URL of the page; the link for a phone opens the view for phones."""
        bearer = self.bearer(self.signed(code="quiet-otter")["token"])
        self.services.invites = MemoryInvites("https://10.0.0.7:8443", "http://10.0.0.7:8080", "http://127.0.0.1:8080")

        def invited(**body: Any) -> dict[str, Any]:
            return dict(self.client.post("/api/v1/invitations", json=body, headers=bearer).get_json())

        viewer, phone = invited(role="viewer"), invited(role="phone", draw=True)
        self.assertEqual(viewer["link"], f"https://10.0.0.7:8443/#code={viewer['token']}")
        self.assertEqual(phone["link"], f"https://10.0.0.7:8443/#code={phone['token']}/phone")
        self.assertEqual((viewer["reaches"], viewer["is_secure"]), ("network", True))
        self.assertNotIn("code", viewer)
        self.assertIn(phone["link"], phone["code"])
        self.assertEqual((phone["certificate"], phone["certificate_code"]), ("", ""))
        here = invited(role="viewer", page="http://127.0.0.1:8080")
        self.assertEqual((here["reaches"], here["is_secure"]), ("machine", False))
        self.assertTrue(here["link"].startswith("http://127.0.0.1:8080/#code="))
        self.assertEqual(self.signed(code=phone["token"])["role"], "phone")
        refused = invited(role="viewer", page="http://10.0.0.8:8080")
        self.assertEqual(refused["error"]["field"], "page")
        self.assertIn("http://10.0.0.7:8080", refused["error"]["remedy"])

    def test_give_the_authority(self) -> None:
        """The authority's certificate is public, and its link uses plain HTTP.

        A missing certificate gives status 404.
        """
        missing = self.client.get("/api/v1/ca.crt")
        self.assertEqual((missing.status_code, missing.get_json()["error"]["field"]), (404, "certificate"))
        pages = ("https://10.0.0.7:8443", "http://10.0.0.7:8080")
        self.services.invites = MemoryInvites(*pages, authority=b"PEM", fingerprint="AB:CD")
        answer = self.client.get("/api/v1/ca.crt")
        self.assertEqual((answer.data, answer.content_type), (b"PEM", "application/x-x509-ca-cert"))
        bearer = self.bearer(self.signed(code="quiet-otter")["token"])
        told = self.client.post("/api/v1/invitations", json={"role": "viewer"}, headers=bearer).get_json()
        self.assertEqual((told["certificate"], told["fingerprint"]), ("http://10.0.0.7:8080/api/v1/ca.crt", "AB:CD"))
