"""Solve the assignment problem exactly by shortest augmenting paths (Jonker and Volgenant, Computing 38, 1987).

Costs are whole numbers, so their sums are exact, and every machine computes the same assignment.
"""

from __future__ import annotations

from collections.abc import Sequence

Costs = Sequence[Sequence[float]]
"""A matrix of whole numbers; they are ``float`` for speed if their sums are exact, otherwise ``int``."""
INEXACT_SUM = 2**52
"""Sums of this size or larger may not be exact in floating point."""


def solve(costs: Costs) -> list[int]:
    """Return the column that is assigned to each row.

    There must be at least as many columns as rows, and all rows must have the same length.  If there are several
    optimal assignments, the result is the lexicographically first one.
    """
    if not costs:
        return []
    if max(map(max, costs)) * len(costs) < INEXACT_SUM:
        costs = [list(map(float, row)) for row in costs]
    return select_first_optimum(costs, *find_optimum(costs))


def find_optimum(costs: Costs) -> tuple[list[int], list[float]]:
    """Return one optimal assignment and the price of each column.

    Prices are at most 0, and the price of a column without a row is 0.  The column of each row has the lowest cost
    minus price in that row, which proves that the assignment is optimal.
    """
    wide = len(costs[0])
    prices: list[float] = [0 * costs[0][0]] * wide  # same type as the costs, so that integer sums stay exact
    owner = [-1] * wide
    free = list(range(len(costs)))
    for _ in range(2):
        free = _run_auction(costs, prices, owner, free)
    for row in free:
        _augment(costs, prices, owner, row)
    columns = [0] * len(costs)
    for column, row in enumerate(owner):
        if row >= 0:
            columns[row] = column
    return columns, prices


def _run_auction(costs: Costs, prices: list[float], owner: list[int], free: list[int]) -> list[int]:
    """Let each free row bid for its best column (auction phase); return the rows that remain free."""
    unassigned: list[int] = []
    bids_left = len(free)
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
            bids_left -= 1
            if second > least and bids_left > 0:
                free.append(displaced)
            else:
                unassigned.append(displaced)
    return unassigned


def _augment(costs: Costs, prices: list[float], owner: list[int], row: int) -> None:
    """Assign a column to ``row`` along the shortest augmenting path and update the prices."""
    length = [cost - price for cost, price in zip(costs[row], prices, strict=True)]
    before = [row] * len(length)
    unscanned = list(range(len(length)))
    scanned: list[int] = []
    while True:
        reached = min(unscanned, key=length.__getitem__)
        shortest = length[reached]
        if owner[reached] < 0:
            break
        unscanned.remove(reached)
        scanned.append(reached)
        through = owner[reached]
        line = costs[through]
        base = shortest - line[reached] + prices[reached]
        for column in unscanned:
            if (candidate_length := base + line[column] - prices[column]) < length[column]:
                length[column] = candidate_length
                before[column] = through
    for column in scanned:
        prices[column] += length[column] - shortest
    where = {owner[column]: column for column in scanned}
    while True:
        through = before[reached]
        owner[reached] = through
        if through == row:
            return
        reached = where[through]


def select_first_optimum(costs: Costs, columns: Sequence[int], prices: Sequence[float]) -> list[int]:
    """Return the lexicographically first assignment with the same cost.

    Each row in turn gets the lowest column with which the whole assignment can still be optimal.
    """
    rows = len(columns)
    columns = [*columns, *sorted(set(range(len(prices))) - set(columns))]
    owner = {column: row for row, column in enumerate(columns)}
    tight = []
    for line, own in zip(costs, columns, strict=False):
        least = line[own] - prices[own]
        tight.append([c for c, (cost, price) in enumerate(zip(line, prices, strict=True)) if cost - price == least])
    # A column without a row can be exchanged, without a change of cost, for any column with price 0.
    tight.append([column for column, price in enumerate(prices) if price == 0])
    for row in range(rows):
        for wanted in tight[row]:
            if wanted >= columns[row] or _exchange_columns(row, wanted, columns, owner, tight):
                break
    return columns[:rows]


def _exchange_columns(row: int, wanted: int, columns: list[int], owner: dict[int, int], tight: list[list[int]]) -> bool:
    """Give ``wanted`` to ``row`` by a cycle of exchanges with later rows; return False if there is no such cycle."""
    reached_from = {wanted: row}
    line = [wanted]
    rows = len(tight) - 1
    has_expanded_unassigned = False
    for column in line:
        if column == columns[row]:
            while True:
                through = reached_from[column]
                freed, columns[through], owner[column] = columns[through], column, through
                if through == row:
                    return True
                column = freed
        holder = owner[column]
        if holder >= rows and has_expanded_unassigned:
            continue  # all unassigned columns have the same exchanges: expand only the first
        has_expanded_unassigned |= holder >= rows
        if holder > row:
            for other in tight[min(holder, rows)]:
                if other not in reached_from:
                    reached_from[other] = holder
                    line.append(other)
    return False
