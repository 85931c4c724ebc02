"""Call a route's handler once per idempotency key, and write each change to the audit log."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.python.failure import Failure

from webnode.errors import Refusal
from webnode.route import Route, RouteRequest

MAX_ANSWERS = 256
"""Number of answers kept for repeated requests."""


class Dispatch:
    """Calls the handlers of routes; on the reactor's thread."""

    def __init__(self) -> None:
        self._answers: OrderedDict[tuple[str, str, str], _Answer] = OrderedDict()

    def carry_out(self, route: Route, request: RouteRequest) -> Deferred[Any]:
        """Return the answer; a request that repeats an id of the same session gets the first answer again."""
        # A route that a viewer may call changes nothing, whatever its method.
        if route.method == "GET" or route.role == "viewer":
            return self._call(route, request)
        # Unauthenticated clients share one identity, so a stored answer could reach a different client.
        if not request.id or route.role == "anyone":
            return self._call_audited(route, request)
        key = request.user.token_id, route.name, request.id
        known = self._answers.get(key)
        if known is None:
            known = self._answers[key] = _Answer()
            while len(self._answers) > MAX_ANSWERS:
                self._answers.popitem(last=False)
            self._call_audited(route, request).addBoth(known.set_outcome)
        return known.wait()

    def _call(self, route: Route, request: RouteRequest) -> Deferred[Any]:
        assert route.handler is not None
        return maybeDeferred(route.handler, request)

    def _call_audited(self, route: Route, request: RouteRequest) -> Deferred[Any]:
        def write_audit(outcome: Any) -> Any:
            result = str(route.status)
            if isinstance(outcome, Failure):
                refusal = outcome.value
                result = f"{refusal.status} {refusal.problem}" if isinstance(refusal, Refusal) else "500"
            named = {name for name in request.values if f"{{{name}}}" in route.path}
            target = " ".join(str(request.values[name]) for name in sorted(named))
            request.services.audit.write(request.user, request.source, route.name, target, result)
            return outcome

        return self._call(route, request).addBoth(write_audit)


class _Answer:
    """The outcome of a route's handler, and the requests that wait for it."""

    def __init__(self) -> None:
        self._outcome: list[Any] = []
        self._waiting: list[Deferred[Any]] = []

    def wait(self) -> Deferred[Any]:
        waiter: Deferred[Any] = Deferred()
        if self._outcome:
            waiter.callback(self._outcome[0])
        else:
            self._waiting.append(waiter)
        return waiter

    def set_outcome(self, outcome: Any) -> None:
        self._outcome.append(outcome)
        waiting, self._waiting = self._waiting, []
        for waiter in waiting:
            waiter.callback(outcome)
