"""Run a fuzz target for some time, with atheris if it is installed, otherwise with simple mutations.

``python -m tests.fuzz.raw --seconds 600`` prints the number of inputs and the duration of the slowest input. An input
that violates a rule is written to a file, and the file name is printed.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FunctionType

from tests.fuzz.ground import Ground

CORPUS = Path(__file__).parent / "corpus"
Check = Callable[[bytes], None]


class Again:
    """A check that creates a new ``Ground`` after every ``period`` inputs, because valid inputs change the state."""

    def __init__(
        self, shot: Callable[[Ground, bytes], None], period: int = 200, made: Callable[[], Ground] = Ground
    ) -> None:
        self._shot = shot
        self._made = made
        self._period = period
        self._left = 0
        self._ground: Ground | None = None

    def __call__(self, data: bytes) -> None:
        """Check one input; raises ``Violation``."""
        if self._ground is None or not self._left:
            if self._ground is not None:
                self._ground.stop()
            self._ground, self._left = self._made(), self._period
        self._left -= 1
        try:
            self._shot(self._ground, data)
        except Exception:
            self._ground = None
            raise


def seeds(name: str) -> list[bytes]:
    """Return the stored inputs of a target."""
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


def mutated(rng: random.Random, inputs: list[bytes]) -> bytes:
    """Return a random mutation of the known inputs."""
    data = bytearray(rng.choice(inputs))
    for _ in range(rng.randrange(1, 6)):
        place = rng.randrange(len(data) + 1)
        match rng.randrange(5):
            case 0:
                data[place:place] = rng.randbytes(rng.randrange(1, 9))
            case 1:
                del data[place : place + rng.randrange(1, 9)]
            case 2 if data:
                data[place % len(data)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 3 if data:
                data[place % len(data)] ^= 1 << rng.randrange(8)
            case _:
                other = rng.choice(inputs)
                data[place:] = other[rng.randrange(len(other) + 1) :]
    return bytes(data[:4096])


def main(name: str, check: Check) -> None:
    """Run a target from the command line."""
    parser = argparse.ArgumentParser(description=f"Fuzzes the wire: {name}.")
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    try:
        import atheris
    except ImportError:
        timed = _Timed(check)
        _mutate(timed, seeds(name), options.seconds, options.seed)
        print(f"{name}: {timed}; plain mutations")  # noqa: T201
        return
    found = tempfile.mkdtemp(prefix=f"fuzz-{name}-")
    print(f"{name}: new inputs go to {found}", flush=True)  # noqa: T201
    arguments = [f"-max_total_time={options.seconds}", f"-seed={options.seed}", f"-artifact_prefix={found}/"]
    arguments += ["-max_len=4096", "-print_final_stats=1", found, str(CORPUS / name)]
    for function in _functions():
        atheris.instrument_func(function)
    atheris.Setup([sys.argv[0], *arguments], check)
    atheris.Fuzz()


def _functions() -> list[FunctionType]:
    """Return the functions and methods of the middleware, for which coverage is measured."""
    found = []
    for name, module in list(sys.modules.items()):
        if name.startswith("middleware.entangled"):
            things = list(vars(module).values())
            things += [inner for thing in things if isinstance(thing, type) for inner in vars(thing).values()]
            found += [thing for thing in things if isinstance(thing, FunctionType) and thing.__module__ == name]
    return found


def _mutate(check: Check, inputs: list[bytes], seconds: float, seed: int) -> None:
    rng = random.Random(seed)
    end = time.monotonic() + seconds
    for data in inputs:
        check(data)
    while time.monotonic() < end:
        data = mutated(rng, inputs)
        try:
            check(data)
        except Exception:
            path = Path(tempfile.gettempdir()) / f"crash-{hashlib.blake2b(data, digest_size=8).hexdigest()}"
            path.write_bytes(data)
            print(f"the input is in {path}", file=sys.stderr)  # noqa: T201
            raise


class _Timed:
    """Counts the inputs, and measures the duration of the slowest input."""

    def __init__(self, check: Check) -> None:
        self._check = check
        self._count = 0
        self._slowest = 0.0

    def __call__(self, data: bytes) -> None:
        begun = time.perf_counter()
        self._check(data)
        self._count += 1
        self._slowest = max(self._slowest, time.perf_counter() - begun)

    def __str__(self) -> str:
        return f"{self._count} inputs, the slowest took {self._slowest * 1000:.1f} ms"
