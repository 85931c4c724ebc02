"""Hungarian: the cheapest assignment of rows to columns, exactly, by shortest augmenting paths.

Jonker, Volgenant, Computing 38, 1987.  Costs are whole numbers, so that sums are exact and every machine finds the
same: of several optima the one whose columns, read row by row, come first.
"""

from __future__ import annotations

from collections.abc import Sequence

Costs = Sequence[Sequence[float]]
"""Whole numbers, as ``int`` or, while they are small, as ``float``, which reckons as exactly and faster."""
BEYOND = 2**52
"""Sums from here on are not exact in floating point."""


def assigned(costs: Costs) -> list[int]:
    """The column of each row; there are at least as many columns as rows, and all rows are equally long."""
    if not costs:
        return []
    if max(map(max, costs)) * len(costs) < BEYOND:
        costs = [list(map(float, row)) for row in costs]
    return first_of_equals(costs, *solved(costs))


def solved(costs: Costs) -> tuple[list[int], list[float]]:
    """One cheapest assignment, and the price of each column: none above 0, and 0 where nobody has it.

    Each row has a column that is cheapest for it, its price taken off; that proves the assignment.
    """
    wide = len(costs[0])
    prices: list[float] = [0 * costs[0][0]] * wide  # of the same kind as the costs, or sums were not exact
    owner = [-1] * wide
    free = list(range(len(costs)))
    for _ in range(2):
        free = _bid(costs, prices, owner, free)
    for row in free:
        _augment(costs, prices, owner, row)
    columns = [0] * len(costs)
    for column, row in enumerate(owner):
        if row >= 0:
            columns[row] = column
    return columns, prices


def _bid(costs: Costs, prices: list[float], owner: list[int], free: list[int]) -> list[int]:
    """Let each free row outbid others for the column it likes best; gives the rows that are free afterwards."""
    lost: list[int] = []
    patience = len(free)
    free = free[::-1]
    while free:
        row = free.pop()
        net = [cost - price for cost, price in zip(costs[row], prices, strict=True)]
        least = min(net)
        best = net.index(least)
        net[best] = float("inf")
        second = min(net)
        if second == least and owner[best] >= 0:
            best = net.index(second)
        elif len(net) > 1:
            prices[best] -= second - least
        displaced, owner[best] = owner[best], row
        if displaced >= 0:
            patience -= 1
            if second > least and patience > 0:
                free.append(displaced)
            else:
                lost.append(displaced)
    return lost


def _augment(costs: Costs, prices: list[float], owner: list[int], row: int) -> None:
    """Give ``row`` a column along the cheapest chain of changes, and mend the prices."""
    length = [cost - price for cost, price in zip(costs[row], prices, strict=True)]
    before = [row] * len(length)
    unscanned = list(range(len(length)))
    scanned: list[int] = []
    while True:
        reached = min(unscanned, key=length.__getitem__)
        so_far = length[reached]
        if owner[reached] < 0:
            break
        unscanned.remove(reached)
        scanned.append(reached)
        through = owner[reached]
        line = costs[through]
        base = so_far - line[reached] + prices[reached]
        for column in unscanned:
            if (there := base + line[column] - prices[column]) < length[column]:
                length[column] = there
                before[column] = through
    for column in scanned:
        prices[column] += length[column] - so_far
    where = {owner[column]: column for column in scanned}
    while True:
        through = before[reached]
        owner[reached] = through
        if through == row:
            return
        reached = where[through]


def first_of_equals(costs: Costs, columns: Sequence[int], prices: Sequence[float]) -> list[int]:
    """Of all assignments that cost as little, the first: row by row the lowest column that the others leave open."""
    rows = len(columns)
    columns = [*columns, *sorted(set(range(len(prices))) - set(columns))]
    owner = {column: row for row, column in enumerate(columns)}
    tight = []
    for line, own in zip(costs, columns, strict=False):
        least = line[own] - prices[own]
        tight.append([c for c, (cost, price) in enumerate(zip(line, prices, strict=True)) if cost - price == least])
    # Who has a column that no row has may change it for any that costs nothing to leave open.
    tight.append([column for column, price in enumerate(prices) if price == 0])
    for row in range(rows):
        for wanted in tight[row]:
            if wanted >= columns[row] or _changed_hands(row, wanted, columns, owner, tight):
                break
    return columns[:rows]


def _changed_hands(row: int, wanted: int, columns: list[int], owner: dict[int, int], tight: list[list[int]]) -> bool:
    """Give ``wanted`` to ``row`` by a ring of changes among those after it; False where there is none."""
    came = {wanted: row}
    line = [wanted]
    rows = len(tight) - 1
    is_asked = False
    for column in line:
        if column == columns[row]:
            while True:
                through = came[column]
                left, columns[through], owner[column] = columns[through], column, through
                if through == row:
                    return True
                column = left
        holder = owner[column]
        if holder >= rows and is_asked:
            continue  # of those who have what no row has one is asked for all: they may change for the same
        is_asked |= holder >= rows
        if holder > row:
            for other in tight[min(holder, rows)]:
                if other not in came:
                    came[other] = holder
                    line.append(other)
    return False
