"""Tests of ``webnode.dispatch``."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.memory import MemoryTeamControl
from webnode.auth import OpenSessions, Role, User
from webnode.dispatch import MAX_ANSWERS, Dispatch
from webnode.errors import Refusal
from webnode.route import Route, RouteRequest
from webnode.services import Services


class DispatchTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.services = Services(MemoryTeamControl(), OpenSessions())
        self.dispatch = Dispatch()
        self.called: list[RouteRequest] = []
        self.told: Any = {"id": 1}

    def answer(self, request: RouteRequest) -> Any:
        self.called.append(request)
        if isinstance(self.told, Refusal):
            raise self.told
        return self.told

    def asked(
        self,
        id: str = "",
        method: Any = "POST",
        name: str = "ann",
        path: str = "/things/{uuid}",
        role: Role = "operator",
    ) -> Deferred[Any]:
        route = Route(method, path, "", role, self.answer, status=202)
        user = User(name, "operator", name)
        return self.dispatch.carry_out(
            route, RouteRequest({"uuid": "01", "x": 5}, user, self.services, {}, id, "10.0.0.9")
        )

    def test_do_once_what_is_asked_twice(self) -> None:
        """A request with a used id gets the response of the first request, even if that is pending or an error."""
        self.assertEqual(self.successResultOf(self.asked("a")), {"id": 1})
        self.told = waiting = Deferred[Any]()
        self.assertEqual(self.successResultOf(self.asked("a")), {"id": 1})
        first, second = self.asked("b"), self.asked("b")
        self.assertNoResult(second)
        waiting.callback({"id": 2})
        self.assertEqual([self.successResultOf(each) for each in (first, second)], [{"id": 2}] * 2)
        self.told = Refusal("device", "it left", "wait", 409)
        for _ in range(2):
            self.assertEqual(self.failureResultOf(self.asked("c"), Refusal).value.status, 409)
        self.assertEqual(len(self.called), 3)

    def test_tell_ids_apart(self) -> None:
        """An id identifies a request only for its user and route; requests without an id are all different."""
        for each in (self.asked("a"), self.asked("a", name="bob"), self.asked("a", path="/others"), self.asked()):
            self.successResultOf(each)
        self.successResultOf(self.asked())
        self.assertEqual(len(self.called), 5)

    def test_forget_old_ids(self) -> None:
        """The responses for the newest ``MAX_ANSWERS`` ids are remembered."""
        for number in range(MAX_ANSWERS + 1):
            self.successResultOf(self.asked(str(number)))
        self.successResultOf(self.asked("1"))
        self.assertEqual(len(self.called), MAX_ANSWERS + 1)
        self.successResultOf(self.asked("0"))
        self.assertEqual(len(self.called), MAX_ANSWERS + 2)

    def test_note_each_change(self) -> None:
        """Each change is audited with user, address, route, target and outcome; reads are not audited."""
        self.successResultOf(self.asked("a"))
        self.successResultOf(self.asked("a"))
        self.successResultOf(self.asked(method="GET"))
        self.successResultOf(self.asked(role="viewer"))
        self.told = Refusal("device", "it left", "wait", 409)
        self.failureResultOf(self.asked(), Refusal)
        self.told = Deferred()
        failing = self.asked()
        self.told.errback(RuntimeError("secret"))
        self.failureResultOf(failing, RuntimeError)
        lines = self.services.audit.list_newest(9)
        line = {"who": "ann", "role": "operator", "from": "10.0.0.9", "route": "POST /things/{uuid}", "target": "01"}
        when: dict[str, object] = {"at": 0.0, "session": "ann"}
        self.assertEqual(lines, [{**line, **when, "outcome": told} for told in ("500", "409 it left", "202")])
