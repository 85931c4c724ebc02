"""Every exception of this room.

::

    WebError
      Refusal     the visitor's fault, or a lawful no: answered as JSON that says field, problem and remedy
      PortTaken   our caller's fault: the page cannot be served there; ``str()`` is one line for a person
"""

from __future__ import annotations


class WebError(Exception):
    """The root of what the web node raises."""


class Refusal(WebError):
    """A wish that is not granted.

    ``field`` is where, ``problem`` what, ``remedy`` what to do about it; ``status`` is the HTTP code.
    """

    def __init__(self, field: str, problem: str, remedy: str, status: int = 400) -> None:
        super().__init__(f"{field}: {problem}; {remedy}")
        self.field = field
        self.problem = problem
        self.remedy = remedy
        self.status = status

    @property
    def fields(self) -> dict[str, dict[str, str]]:
        """The body of the answer."""
        return {"error": {"field": self.field, "problem": self.problem, "remedy": self.remedy}}


class PortTaken(WebError):
    """Another program holds the port of the page, or the address is not one of this machine."""
