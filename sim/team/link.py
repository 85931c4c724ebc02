"""Model the links between the nodes of a team: LAN, Wi-Fi or internet, with bursts, queues and losses.

State is stored per sender and per receiver, not per pair, because ten thousand nodes have fifty million pairs. So a
loss burst affects a sender, a queue belongs to an access link, and the distance of two nodes follows from their
positions.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from formats.convert import Unit, one_of
from middleware.entangled.network.network import Address

KINDS = ("none", "lan", "wifi", "internet")
MEAN_RTT_S = 0.156
"""Mean round-trip time of the King data set in seconds, as in the published simulations used for comparison."""
ACCESS_DELAY_S = 0.0125
"""Mean one-way delay of a node's access link in seconds, for every peer."""
SIDE_S = (MEAN_RTT_S / 2 - 2 * ACCESS_DELAY_S) / 0.521405
"""Side of the square of node positions, as one-way delay in seconds; 0.5214 is the mean distance in a unit square."""
SPREAD = 0.05
"""Relative variation of the delays of one pair."""
LOST: tuple[float, ...] = ()


@dataclass(frozen=True)
class LinkSettings:
    """``[link]``: the links between the nodes."""

    kind: Annotated[str, one_of(KINDS)] = "lan"
    """The one-way delay. ``none``: 0. ``lan``: 0.2 to 0.6 ms. ``wifi``: at least 1 ms, 5 ms on average. ``internet``:
    depends on the positions of the nodes; the mean round-trip time is 156 ms."""

    loss: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Share of datagrams lost in each direction."""

    burst: Annotated[float, Meta(ge=0.0, le=10.0), Unit("seconds")] = 0.0
    """Mean duration in seconds of a sender's loss bursts (Gilbert-Elliott), with ``loss`` as the mean loss rate; 0:
    independent losses."""

    asymmetry: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Relative asymmetry of losses: one direction of a pair loses more than ``loss`` by this share, the other less."""

    duplicate: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Share of datagrams that arrive twice."""

    reorder: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Share of datagrams with twice the delay plus a millisecond, so that others overtake them."""

    bandwidth: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0
    """Bytes per second that a node can send; 0: unlimited."""

    queue: Annotated[float, Meta(ge=0.001, le=60.0), Unit("seconds")] = 0.5
    """Maximum queueing time of a datagram in seconds; a datagram that would wait longer is lost."""


class TeamLink:
    """The link model of a switchboard (``switchboard.LinkModel``); ``seed`` determines the positions of nodes."""

    def __init__(self, settings: LinkSettings, seed: str) -> None:
        self.settings = settings
        self.extra_loss = 0.0
        """Additional share of datagrams lost while a fault of kind ``weather`` is active."""
        self._seed = seed
        self._loss = settings.loss
        self._plain_loss = settings.loss if not (settings.burst or settings.asymmetry) else 0.0
        self._bursts: dict[Address, tuple[float, bool]] = {}
        self._free_at: dict[Address, float] = {}
        self._positions: dict[Address, tuple[float, float, float]] = {}
        self._delay = getattr(self, f"_{settings.kind}")
        self._is_plain = not (settings.duplicate or settings.reorder or settings.bandwidth)

    def draw_delays(self, source: Address, to: Address, size: int, now: float, rng: random.Random) -> Sequence[float]:
        """Return the delay of each copy of a datagram in seconds; empty if the datagram is lost."""
        if self._loss and self._is_lost(source, to, now, rng):
            return LOST
        if self.extra_loss and rng.random() < self.extra_loss:
            return LOST
        if self._is_plain:
            return (self._delay(source, to, rng),)
        settings, queueing = self.settings, 0.0
        if settings.bandwidth:
            begins = max(now, self._free_at.get(source, 0.0))
            if begins - now > settings.queue:
                return LOST
            self._free_at[source] = begins + size / settings.bandwidth
            queueing = self._free_at[source] - now
        copies = 2 if settings.duplicate and rng.random() < settings.duplicate else 1
        delays = [self._delay(source, to, rng) for _ in range(copies)]
        if settings.reorder:
            delays = [2 * d + 0.001 if rng.random() < settings.reorder else d for d in delays]
        return [queueing + delay for delay in delays]

    def distance(self, source: Address, to: Address) -> float:
        """Return the one-way delay between two nodes on the internet in seconds, without variation."""
        (x, y, height), (x2, y2, height2) = self._get_position(source), self._get_position(to)
        return math.hypot(x - x2, y - y2) + height + height2

    # -- inside -----------------------------------------------------------------------------------------------------

    def _is_lost(self, source: Address, to: Address, now: float, rng: random.Random) -> bool:
        if self._plain_loss:
            return rng.random() < self._plain_loss
        settings, loss = self.settings, self._loss
        if settings.asymmetry:
            loss = min(0.99, loss * (1 + settings.asymmetry if source < to else 1 - settings.asymmetry))
        if not settings.burst:
            return rng.random() < loss
        # A two-state Markov chain in continuous time: the current state is drawn from the last observed state.
        since, was_bad = self._bursts.get(source, (-1e9, False))
        remembered = math.exp((since - now) / (settings.burst * (1 - loss)))
        is_bad = rng.random() < loss + ((1.0 if was_bad else 0.0) - loss) * remembered
        self._bursts[source] = now, is_bad
        return is_bad

    def _get_position(self, address: Address) -> tuple[float, float, float]:
        position = self._positions.get(address)
        if position is None:
            position_rng = random.Random(f"{self._seed}/{address}")
            position = (
                position_rng.uniform(0, SIDE_S),
                position_rng.uniform(0, SIDE_S),
                position_rng.expovariate(1 / ACCESS_DELAY_S),
            )
            self._positions[address] = position
        return position

    def _none(self, source: Address, to: Address, rng: random.Random) -> float:
        return 0.0

    def _lan(self, source: Address, to: Address, rng: random.Random) -> float:
        return 0.0002 + 0.0004 * rng.random()

    def _wifi(self, source: Address, to: Address, rng: random.Random) -> float:
        return 0.001 + rng.expovariate(250.0)

    def _internet(self, source: Address, to: Address, rng: random.Random) -> float:
        return self.distance(source, to) * (1 - SPREAD + 2 * SPREAD * rng.random())
