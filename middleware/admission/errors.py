"""Every exception of admission beside those of the library below; ``str()`` is one line that a person can act upon.

::

    EntangledError
      LocalError
        BadCode       read the code again, or ask for another one
        BadKeyFile    mend the file, its mode or its place
      Refused
        NotWelcome    ask the team's operator; ``code`` says why
"""

from __future__ import annotations

from middleware.entangled.errors import LocalError, Refused

_ASK = "ask the operator for another one (swarm invite)"
WHY = {
    "unknown": f"nobody there knows this code: it is of another team, was withdrawn, or ran out long ago; {_ASK}",
    "used": f"this code was used as often as it may be; {_ASK}",
    "expired": f"this code has run out; {_ASK}, and look whether this machine's clock is right",
    "early": "this code is not valid yet; look whether the clocks of both machines are right",
    "revoked": f"this code was revoked; {_ASK}",
    "name": "another member has this name; choose another one (swarm join CODE --name NAME)",
    "later": "too few of the team can be reached to say whether this code was used; try again when more are there",
    "role": "the node asked lets nobody in; name a bootstrap node, or make it one (swarm promote NAME)",
    "old": f"this code was made by an older version of the software; {_ASK}",
    "foreign": "the answer comes from another team than the code; read it again, or ask the operator",
}
"""What each refusal of a newcomer means, and what to do."""


class BadCode(LocalError):
    """A code of an invitation that cannot be one: what is wrong, and where."""


class BadKeyFile(LocalError):
    """A file with secrets that cannot be used as it is; the message says why and what to do."""


class NotWelcome(Refused):
    """A team does not let this newcomer in; ``code`` is a key of ``WHY``."""

    code = "unknown"

    def __init__(self, code: str) -> None:
        super().__init__(WHY.get(code, WHY["unknown"]), code)
