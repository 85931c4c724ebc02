"""Write the states of an agent into docs/how-to/write-tasks-behaviours-strategies.md.

Usage: ``python -m tests.agents.state_table``.
"""

from __future__ import annotations

from pathlib import Path

from agents.state import ROWS, TABLE, State

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "write-tasks-behaviours-strategies.md"
BEGIN, END = "<!-- states: python -m tests.agents.state_table -->\n", "<!-- end of the states -->\n"
PRESENT = "PRESENT"
PRESENT_STATES = State.OBSERVING, State.REPORTED, State.WAITING, State.CLAIMING, State.FENCED
"""The states of an agent that does not act and has a free robot. The drawing merges them: each event has one target."""


def write_states() -> str:
    """Return the table of states, the diagram of their transitions, and the table of events."""
    states = "".join(f"| {state.name} | {state.status} | {state.text} |\n" for state in State)
    inside: dict[str, list[str]] = {}
    arrows: dict[str, list[str]] = {}
    for (state, event), (target, _) in TABLE.items():
        ends = [PRESENT if one in PRESENT_STATES else one.name for one in (state, target)]
        if ends[0] != ends[1]:
            arrows.setdefault(f"{ends[0]} --> {ends[1]}", []).append(event.name)
        if ends[1] == PRESENT and state is not target:
            inside.setdefault(f"[*] --> {target.name}", []).append(event.name)
    rows, before = "", None
    for row in ROWS:
        if row.target or row.effects:
            name = "| " if row.event is before else f"{row.event.name} | {row.event.value}"
            effects = ", ".join(effect.name for effect in row.effects)
            goal = row.target.name if row.target else ""
            rows += f"| {name} | {_name(row.states)} | {goal} | {effects} |\n"
            before = row.event
    return (
        f"{BEGIN}\n| state | status | the agent |\n|---|---|---|\n{states}\n"
        f"```mermaid\nstateDiagram-v2\n    [*] --> IDLE\n{_draw(arrows)}"
        f"    state {PRESENT} {{\n{_draw(inside, 8)}    }}\n```\n\n"
        f"| event | | in | leads to | effects, in this order |\n|---|---|---|---|---|\n{rows}\n{END}"
    )


def _name(states: tuple[State, ...]) -> str:
    is_whole = set(PRESENT_STATES) <= set(states)
    names = [PRESENT if is_whole and state in PRESENT_STATES else state.name for state in states]
    return ", ".join(dict.fromkeys(names))


def _draw(arrows: dict[str, list[str]], indent: int = 4) -> str:
    return "".join(f"{' ' * indent}{arrow}: {', '.join(dict.fromkeys(events))}\n" for arrow, events in arrows.items())


def main() -> None:
    """Replace the section about the states in the page."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN, 1)
    PAGE.write_text(before + write_states() + rest.split(END, 1)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
