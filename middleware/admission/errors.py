"""Exceptions of admission; ``str()`` is one line with the cause and the remedy.

::

    EntangledError
      LocalError
        BadCode       check the code, or ask for a new code
        BadKeyFile    fix the file, its mode or its path
      Refused
        NotWelcome    ask the team's operator; ``code`` is the reason
"""

from __future__ import annotations

from middleware.entangled.errors import LocalError, Refused

_ASK = "ask the operator for another one (swarm invite)"
REFUSAL_TEXTS = {
    "unknown": f"the team does not know this code: it is of another team, was withdrawn, or expired long ago; {_ASK}",
    "used": f"this code was used as often as it may be; {_ASK}",
    "expired": f"this code has expired; {_ASK}, and check the clock of this machine",
    "early": "this code is not valid yet; check the clocks of both machines",
    "revoked": f"this code was revoked; {_ASK}",
    "name": "another member has this name; choose another one (swarm join CODE --name NAME)",
    "later": "the bootstrap node reaches too few members to check this code; try again when more are online",
    "role": "that node does not admit newcomers; name a bootstrap node, or make it one (swarm promote NAME)",
    "old": f"this code was made by an older version of the software; {_ASK}",
    "foreign": "the reply comes from another team than the code; check the code, or ask the operator",
}
"""Meaning and remedy of each refusal of a newcomer."""


class BadCode(LocalError):
    """The text is not a valid join code."""


class BadKeyFile(LocalError):
    """A file with secrets cannot be used; the message says why and what to do."""


class NotWelcome(Refused):
    """The team rejects the newcomer; ``code`` is a key of ``REFUSAL_TEXTS``."""

    code = "unknown"

    def __init__(self, code: str) -> None:
        super().__init__(REFUSAL_TEXTS.get(code, REFUSAL_TEXTS["unknown"]), code)
