"""The module's side of the channel, in the module's process: load one module and answer the node's requests.

Before the module's source is executed, ``confine`` is called with the source; it drops the privileges of the process
and returns the limits in effect.  A ``ModuleKind`` handles the modules of one kind.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from middleware.consensus.deployed_modules import STRATEGY, Factory
from middleware.consensus.remote_strategy import run_call as answer_of
from middleware.consensus.strategy import find_read_fields
from middleware.deployment import module_channel
from middleware.deployment.manifest import Manifest
from middleware.deployment.module_channel import (
    CALL,
    DROP,
    LOAD,
    MAKE,
    MAX_REPLY_BYTES,
    MAX_REQUEST_BYTES,
    STRATEGY_INSTANCE,
    BadFrame,
    FrameSplitter,
    ProcessEnded,
)
from middleware.deployment.module_loader import load_module
from middleware.errors import Undeployable

MAX_INSTANCES = 64
MAX_REASON = 1000

Confine = Callable[[bytes], Sequence[str]]


class ModuleKind(Protocol):
    """Creates and calls modules of one kind, with plain values as arguments and results."""

    def make(self, make: Factory, arguments: list[Any]) -> object:
        """Create an instance."""

    def describe_instance(self, thing: object) -> dict[str, Any]:
        """Return the data about an instance that the node needs."""

    def call(self, thing: object, method: str, arguments: list[Any]) -> object:
        """Call ``method`` of an instance."""


class StrategyKind:
    """Handles strategies."""

    def make(self, make: Factory, arguments: list[Any]) -> object:
        """Create the strategy."""
        return make()

    def describe_instance(self, thing: object) -> dict[str, Any]:
        """Return the report fields that the strategy reads, in addition to the cost."""
        return {"reads": list(find_read_fields(thing))}

    def call(self, thing: object, method: str, arguments: list[Any]) -> object:
        """Call ``method`` of the strategy."""
        return answer_of(thing, method, arguments)


class ModuleHost:
    """One module with its instances; only a behaviour can have several instances."""

    def __init__(self, kinds: Mapping[str, ModuleKind], confine: Confine) -> None:
        self._kinds = kinds
        self._confine = confine
        self._kind: ModuleKind | None = None
        self._make: Factory | None = None
        self._instances: dict[int, object] = {}

    def answer_request(self, request: bytes) -> bytes:
        """Return the packed reply to one request; an exception of the module becomes an error reply."""
        number = 0
        try:
            number, verb, arguments = module_channel.parse_request(request)
            verbs: dict[str, Callable[..., object]] = {
                LOAD: self._load,
                MAKE: self._create,
                CALL: self._call,
                DROP: self._drop,
            }
            packed = module_channel.pack([number, True, verbs[verb](*arguments)])
            if len(packed) <= MAX_REPLY_BYTES:
                return packed
            why = f"its reply has {len(packed)} bytes, more than {MAX_REPLY_BYTES}"
        except Undeployable as error:
            why = error.problem
        except BadFrame as error:
            why = f"its reply {error}"
        except BaseException as error:  # a pushed module can raise anything
            why = "".join(traceback.format_exception_only(error)).strip()
        return module_channel.pack([number, False, why[:MAX_REASON].encode(errors="replace").decode()])

    def _load(self, name: str, kind: str, version: int, digest: str, size: int, source: bytes) -> object:
        limits = list(self._confine(source))
        self._kind = self._kinds[kind]
        self._make = load_module(Manifest(name, kind, version, digest, size), source)
        facts: dict[str, Any] = {"limits": limits}
        if kind == STRATEGY:
            thing = self._instances[STRATEGY_INSTANCE] = self._kind.make(self._make, [])
            facts |= self._kind.describe_instance(thing)
        return facts

    def _create(self, instance_number: int, arguments: list[Any]) -> object:
        assert self._kind is not None and self._make is not None
        if len(self._instances) >= MAX_INSTANCES:
            raise Undeployable(str(instance_number), f"already has {MAX_INSTANCES} instances")
        thing = self._instances[instance_number] = self._kind.make(self._make, arguments)
        return self._kind.describe_instance(thing)

    def _call(self, instance_number: int, method: str, arguments: list[Any]) -> object:
        assert self._kind is not None
        return self._kind.call(self._instances[instance_number], method, arguments)

    def _drop(self, instance_number: int) -> object:
        self._instances.pop(instance_number, None)
        return None


class MemoryChannel:
    """The channel of a module in this process, with the same messages; for simulators and tests."""

    has_unsent = False

    def __init__(self, kinds: Mapping[str, ModuleKind]) -> None:
        self._host: ModuleHost | None = ModuleHost(kinds, lambda source: ["simulated"])
        self._requests = FrameSplitter(MAX_REQUEST_BYTES)
        self._replies = FrameSplitter(MAX_REPLY_BYTES)
        self._ready: list[bytes] = []

    def send(self, message: bytes) -> None:
        """Answer the request immediately."""
        if self._host is None:
            raise ProcessEnded("its process has ended")
        try:
            for request in self._requests.feed(message):
                self._ready += self._replies.feed(self._host.answer_request(request))
        except BadFrame as error:
            raise ProcessEnded(f"its reply {error}") from error

    def receive(self, within_s: float) -> list[bytes]:
        """Return the replies since the last call."""
        if self._host is None:
            raise ProcessEnded("its process has ended")
        ready, self._ready = self._ready, []
        return ready

    def kill(self) -> None:
        """Discard the module."""
        self._host = None
