"""The lease and the agreement under which a behaviour acts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Context:
    """The lease and the agreement under which a behaviour acts at the time ``now``.

    - ``token``: the lease's fencing token
    - ``deadline``: the end of the lease, on the clock of ``now``
    - ``began``: the time of the first call with this token
    - ``is_resumed``: the token is the same as in the previous call, so no other agent has acted since that call. With
      a new token another agent may have acted, and earlier results may be invalid.
    - ``value``, ``choice``: the agreed number or position, and the option that won the vote, if the strategy
      determines them. While a decision is repeated under the same token, for example after an agent has joined, both
      keep their last values.
    """

    now: float
    token: int = 0
    deadline: float = 0.0
    began: float = 0.0
    is_resumed: bool = False
    value: tuple[float, ...] = ()
    choice: str = ""
