"""Census: who lives, sorted by id; the truth that lookups are held against."""

from __future__ import annotations

from bisect import bisect_left, insort

from middleware.entangled.identity import ID_BYTES

BITS = 8 * ID_BYTES


class Census:
    """The ids of those that live.

    Ids that share their first bits stand side by side in the order of their numbers, so those closest to a key are
    found without looking at everybody: the narrowest such stretch around the key that has enough of them holds them.
    """

    def __init__(self) -> None:
        self._numbers: list[int] = []

    def __len__(self) -> int:
        return len(self._numbers)

    def __contains__(self, node_id: bytes) -> bool:
        return self._place(int.from_bytes(node_id)) is not None

    def born(self, node_id: bytes) -> None:
        """One more lives; nothing happens where it did already."""
        number = int.from_bytes(node_id)
        if self._place(number) is None:
            insort(self._numbers, number)

    def died(self, node_id: bytes) -> None:
        """One lives no more; nothing happens where it did not."""
        place = self._place(int.from_bytes(node_id))
        if place is not None:
            del self._numbers[place]

    def closest(self, key: bytes, count: int, without: bytes = b"") -> list[bytes]:
        """The ids of the ``count`` closest to ``key``, the closest first; ``without`` is passed over."""
        goal = int.from_bytes(key)
        passed = int.from_bytes(without) if without else -1
        first, end = 0, len(self._numbers)
        for bits in range(1, BITS + 1):  # the more first bits are shared, the narrower
            low = goal >> (BITS - bits) << (BITS - bits)
            next_first = bisect_left(self._numbers, low, first, end)
            next_end = bisect_left(self._numbers, low + (1 << (BITS - bits)), next_first, end)
            if next_end - next_first <= count:  # one of them may be passed over
                break
            first, end = next_first, next_end
        near = [number for number in self._numbers[first:end] if number != passed]
        near.sort(key=lambda number: number ^ goal)
        return [number.to_bytes(ID_BYTES) for number in near[:count]]

    def _place(self, number: int) -> int | None:
        place = bisect_left(self._numbers, number)
        return place if place < len(self._numbers) and self._numbers[place] == number else None
