"""The lease and the agreement under which a behaviour acts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Context:
    """The lease and the agreement under which a behaviour acts at the time ``now``.

    - ``token``: the lease's fencing token
    - ``deadline``: the end of the lease, on the clock of ``now``
    - ``began``: the time of the first call with this token
    - ``is_resumed``: the token is the same as in the previous call, so no other agent has acted in between.
      With a new token another agent may have acted, and earlier results may be void.
    - ``value``, ``choice``: the agreed number or place, or the option that won the vote, if the strategy finds one.
      They persist under one token while a decision is open again, for example after a new agent has joined.
    """

    now: float
    token: int = 0
    deadline: float = 0.0
    began: float = 0.0
    is_resumed: bool = False
    value: tuple[float, ...] = ()
    choice: str = ""
