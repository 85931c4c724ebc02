"""Exceptions of the node outside its peer-to-peer library, each with the remedy for the operator.

::

    SwarmError
      BadSetting         correct the settings file or the command line
      MissingExtra       install the named extra
      UnknownTask        use an existing kind of task or behaviour
      UnknownStrategy    use an existing consensus strategy
      UnknownAgent       use an existing agent
      Undeployable       correct the module and push it again as a higher version
      BadFault           use an existing kind of fault, with values in range
"""

from __future__ import annotations


class SwarmError(Exception):
    """Base class of the node's exceptions; ``str()`` is one line with the problem and the remedy."""


class BadSetting(SwarmError):
    """A setting is invalid; ``file`` is its settings file, empty for a command-line flag."""

    def __init__(self, file: str, key: str, problem: str, remedy: str) -> None:
        super().__init__(file, key, problem, remedy)
        self.file = file
        self.key = key
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return " ".join(": ".join(filter(None, (self.file, self.key, f"{self.problem}; {self.remedy}"))).split())


class MissingExtra(SwarmError):
    """The libraries that an optional part needs are not installed."""

    def __init__(self, part: str, extra: str) -> None:
        super().__init__(part, extra)
        self.part = part
        self.extra = extra

    def __str__(self) -> str:
        return f"{self.part} needs libraries that are not installed; run: pip install 'swarm-node[{self.extra}]'"


class UnknownTask(SwarmError):
    """No predefined task, or no behaviour for a task, has this name."""


class UnknownStrategy(SwarmError):
    """No consensus strategy has this name, or it cannot be loaded."""


class UnknownAgent(SwarmError):
    """No agent has this name, or it cannot be loaded."""


class Undeployable(SwarmError):
    """A module that an operator pushed to the team cannot run."""

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(name, problem)
        self.name = name
        self.problem = problem

    def __str__(self) -> str:
        return " ".join(f"the module {self.name} cannot run: {self.problem}".split())


class BadFault(SwarmError):
    """A fault cannot be injected because ``field`` is invalid."""

    def __init__(self, field: str, problem: str, remedy: str) -> None:
        super().__init__(field, problem, remedy)
        self.field = field
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.field}: {self.problem}; {self.remedy}"
