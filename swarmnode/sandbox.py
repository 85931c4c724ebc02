"""Sandbox: the process in which one pushed module runs; ``python -m swarmnode.sandbox PARENT``.

It reads questions from standard input and writes answers to standard output.  It first imports the libraries of a fixed
list that the module names, then gives up its rights, and only then reads the source as Python.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial

from agents.pushed import BehaviourKind
from middleware.consensus.deployed import BEHAVIOUR, STRATEGY
from middleware.deployment.confinement import confine
from middleware.deployment.frame import MAX_QUESTION, Channel, Splitter
from middleware.deployment.host import Host, Kind, MemoryChannel, StrategyKind

READ_BYTES = 64 * 1024
LIBRARIES = (
    *("abc", "base64", "bisect", "cmath", "collections", "collections.abc", "colorsys", "contextlib", "copy"),
    *("dataclasses", "datetime", "decimal", "enum", "fractions", "functools", "hashlib", "heapq", "itertools"),
    *("json", "math", "numbers", "operator", "random", "re", "statistics", "string", "struct", "textwrap", "time"),
    *("traceback", "types", "typing", "zlib", "cv2", "numpy"),
)
PREFIXES = ("agents.", "drivers.reading", "middleware.consensus.", "middleware.entangled.value", "numpy.")
"""Where else a module may import from: names that begin so."""
LATER = {"numpy": ("numpy.fft", "numpy.random")}
"""Modules that a library imports at first use, which is too late here."""
_IMPORT = re.compile(rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import|import[ \t]+([\w., \t]+))", re.MULTILINE)


def kinds() -> Mapping[str, Kind]:
    """How modules of each kind are served."""
    return {STRATEGY: StrategyKind(), BEHAVIOUR: BehaviourKind()}


def simulated() -> Channel:
    """The twin of a process, for simulated teams."""
    return MemoryChannel(kinds())


def wanted(source: bytes) -> list[str]:
    """The allowed libraries that ``source`` names, to be imported before the rights are given up."""
    named: set[str] = set()
    for one, several in _IMPORT.findall(source):
        words = [one] if one else [part.split()[0] for part in several.split(b",") if part.split()]
        named.update(word.decode("ascii", "replace") for word in words)
    known = {name for name in named if name in LIBRARIES or name.startswith(PREFIXES)}
    return sorted(known.union(*(LATER.get(name, ()) for name in known)))


def _prepared(parent: int, source: bytes) -> list[str]:
    for name in wanted(source):
        with suppress(Exception):  # the module's own import raises again
            importlib.import_module(name)
    os.environ.clear()
    sys.path.clear()
    return confine(parent)


def main() -> None:
    """Answer until the node closes the pipe."""
    out = os.dup(1)
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)  # output of the module is no answer
    os.close(null)
    with suppress(OSError):
        os.rmdir(os.getcwd())  # the folder is empty, and stays so
    host = Host(kinds(), partial(_prepared, int(sys.argv[1])))
    questions = Splitter(MAX_QUESTION)
    while data := os.read(0, READ_BYTES):
        for question in questions.feed(data):
            rest = host.answer(question)
            while rest:
                rest = rest[os.write(out, rest) :]


if __name__ == "__main__":
    main()
