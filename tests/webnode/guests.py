"""Sessions for tests, in which the token is the name of the role."""

from __future__ import annotations

from typing import get_args

from webnode.visitor import OpenSessions, Role, Visitor


class Guests(OpenSessions):
    def visitor(self, token: str, now: float) -> Visitor:
        """Return a visitor with the role that the token names."""
        for role in get_args(Role):
            if token == role:
                return Visitor(token, role, f"id of {token}")
        return Visitor()
