"""Exceptions of the package ``webnode``.

::

    WebError
      Refusal     a request is rejected: answered as JSON with field, problem and remedy
      PortTaken   the page cannot be served at the given port; ``str()`` is one line for the operator
"""

from __future__ import annotations


class WebError(Exception):
    """Base class of the errors of this package."""


class Refusal(WebError):
    """A rejected request.

    ``field`` is the place of the ``problem``, ``remedy`` the advice to the client, ``status`` the HTTP status code.
    """

    def __init__(self, field: str, problem: str, remedy: str, status: int = 400) -> None:
        super().__init__(f"{field}: {problem}; {remedy}")
        self.field = field
        self.problem = problem
        self.remedy = remedy
        self.status = status

    @property
    def fields(self) -> dict[str, dict[str, str]]:
        """The JSON body of the response."""
        return {"error": {"field": self.field, "problem": self.problem, "remedy": self.remedy}}


class PortTaken(WebError):
    """The port is used by another program, or the address does not belong to this machine."""
