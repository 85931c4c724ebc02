"""Context: under which right a body acts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Context:
    """Under which right a body acts ``now``: the lease's ``token``, and its ``deadline`` on the same clock.

    ``is_resumed`` says that the token is the one of the call before, so that nobody acted in between: go on.  With a
    new token, held since ``began``, another may have acted: what was done so far is still remembered, and may be void.

    ``value`` is the number or place that all agreed on, ``choice`` the option, where the task's strategy finds one.
    Under one token it stays while it is open again, as it is when somebody comes who has not voted yet.
    """

    now: float
    token: int = 0
    deadline: float = 0.0
    began: float = 0.0
    is_resumed: bool = False
    value: tuple[float, ...] = ()
    choice: str = ""
