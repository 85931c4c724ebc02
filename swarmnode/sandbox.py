"""The process in which one pushed module runs: ``python -m swarmnode.sandbox PARENT``.

It reads requests from standard input and writes replies to standard output.  It first imports those libraries of a
fixed list that the module uses, then drops its privileges, and only then parses the source as Python.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial

from agents.behaviour_process import BehaviourKind
from middleware.consensus.deployed_modules import BEHAVIOUR, STRATEGY
from middleware.deployment.confinement import confine
from middleware.deployment.module_channel import MAX_REQUEST_BYTES, Channel, FrameSplitter
from middleware.deployment.module_host import MemoryChannel, ModuleHost, ModuleKind, StrategyKind

READ_BYTES = 64 * 1024
ALLOWED_LIBRARIES = (
    *("abc", "base64", "bisect", "cmath", "collections", "collections.abc", "colorsys", "contextlib", "copy"),
    *("dataclasses", "datetime", "decimal", "enum", "fractions", "functools", "hashlib", "heapq", "itertools"),
    *("json", "math", "numbers", "operator", "random", "re", "statistics", "string", "struct", "textwrap", "time"),
    *("traceback", "types", "typing", "zlib", "cv2", "numpy"),
)
ALLOWED_PREFIXES = ("agents.", "drivers.reading", "middleware.consensus.", "middleware.entangled.value", "numpy.")
"""Prefixes of further names that a pushed module may import."""
LAZY_IMPORTS = {"numpy": ("numpy.fft", "numpy.random")}
"""Modules that a library imports at first use; they are imported early, because later imports are not possible."""
_IMPORT = re.compile(rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import|import[ \t]+([\w., \t]+))", re.MULTILINE)


def make_kinds() -> Mapping[str, ModuleKind]:
    """Return the handler of each kind of module."""
    return {STRATEGY: StrategyKind(), BEHAVIOUR: BehaviourKind()}


def make_memory_channel() -> Channel:
    """Return an in-memory channel, for simulated teams."""
    return MemoryChannel(make_kinds())


def find_allowed_imports(source: bytes) -> list[str]:
    """Return the allowed libraries that ``source`` imports; they are loaded before privileges are dropped."""
    named: set[str] = set()
    for one, several in _IMPORT.findall(source):
        words = [one] if one else [part.split()[0] for part in several.split(b",") if part.split()]
        named.update(word.decode("ascii", "replace") for word in words)
    known = {name for name in named if name in ALLOWED_LIBRARIES or name.startswith(ALLOWED_PREFIXES)}
    return sorted(known.union(*(LAZY_IMPORTS.get(name, ()) for name in known)))


def _prepare(parent: int, source: bytes) -> list[str]:
    for name in find_allowed_imports(source):
        with suppress(Exception):  # the pushed module's own import raises the same error
            importlib.import_module(name)
    os.environ.clear()
    sys.path.clear()
    return confine(parent)


def main() -> None:
    """Answer requests until the node closes the pipe."""
    out = os.dup(1)
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)  # printed output of the module must not be taken for a reply
    os.close(null)
    with suppress(OSError):
        os.rmdir(os.getcwd())  # the folder is empty and not needed
    host = ModuleHost(make_kinds(), partial(_prepare, int(sys.argv[1])))
    questions = FrameSplitter(MAX_REQUEST_BYTES)
    while data := os.read(0, READ_BYTES):
        for question in questions.feed(data):
            rest = host.answer_request(question)
            while rest:
                rest = rest[os.write(out, rest) :]


if __name__ == "__main__":
    main()
