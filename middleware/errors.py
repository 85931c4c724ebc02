"""Every exception of the node above its peer-to-peer library; the class says what a person can do about it.

::

    SwarmError
      BadSetting         mend the settings file, or the command line
      MissingExtra       install the named extra
      UnknownTask        ask for a kind of task, or a behaviour, that exists
      UnknownStrategy    ask for a consensus strategy that exists
      UnknownAgent       ask for an agent that exists
      Undeployable       mend the module, and push it again as a higher version
      BadFault           ask for a fault that exists, within its bounds
"""

from __future__ import annotations


class SwarmError(Exception):
    """The root of what a node raises of itself; ``str()`` is one line that a person can act upon."""


class BadSetting(SwarmError):
    """A setting cannot be used: in which file (or on the command line), which key, what is wrong, and what to do."""

    def __init__(self, file: str, key: str, problem: str, remedy: str) -> None:
        super().__init__(file, key, problem, remedy)
        self.file = file
        self.key = key
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return " ".join(": ".join(filter(None, (self.file, self.key, f"{self.problem}; {self.remedy}"))).split())


class MissingExtra(SwarmError):
    """A part of the program was asked for whose libraries are not installed."""

    def __init__(self, part: str, extra: str) -> None:
        super().__init__(part, extra)
        self.part = part
        self.extra = extra

    def __str__(self) -> str:
        return f"{self.part} needs more than the bare node; install it by: pip install 'swarm-node[{self.extra}]'"


class UnknownTask(SwarmError):
    """No predefined task, or no behaviour for a task, has this name."""


class UnknownStrategy(SwarmError):
    """No consensus strategy has this name, or it cannot be loaded."""


class UnknownAgent(SwarmError):
    """No agent has this name, or it cannot be loaded."""


class Undeployable(SwarmError):
    """A module that was pushed to the team cannot run: its name, and what is wrong with it."""

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(name, problem)
        self.name = name
        self.problem = problem

    def __str__(self) -> str:
        return " ".join(f"the module {self.name} cannot run: {self.problem}".split())


class BadFault(SwarmError):
    """A fault that cannot be caused: which field of it, what is wrong, and what to do."""

    def __init__(self, field: str, problem: str, remedy: str) -> None:
        super().__init__(field, problem, remedy)
        self.field = field
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.field}: {self.problem}; {self.remedy}"
