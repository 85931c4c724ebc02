"""Write the states of a lease client into docs/explanation/choosing-a-robot.md, between its markers."""

from __future__ import annotations

from pathlib import Path

from middleware.consensus.lease.client_states import ACTIVE, TABLE, Event, State

PAGE = Path(__file__).parents[4] / "docs" / "explanation" / "choosing-a-robot.md"
BEGIN = "<!-- states: python -m tests.middleware.consensus.lease.state_table -->\n"
END = "<!-- end of the states -->\n"
UNDRAWN = (Event.RELEASE, Event.OUTRANK, Event.MOVE, Event.MOVED, Event.COMPLETED, Event.ENDED)
"""Events with a transition from nearly every state; the table contains them, the drawing does not."""


def write_states() -> str:
    """Return three parts of the page: the table of states, the drawing of transitions, and the table of events."""
    states = "".join(f"| {state.name} | {state.value} |\n" for state in State)
    arrows: dict[str, list[str]] = {}
    for state, row in TABLE.items():
        for event, (target, _) in row.items():
            if event not in UNDRAWN and state is not target:
                arrows.setdefault(f"{state.name} --> {target.name}", []).append(event.name)
    drawing = "".join(f"    {arrow}: {', '.join(events)}\n" for arrow, events in arrows.items())
    return (
        f"{BEGIN}\n| state | the client |\n|---|---|\n{states}\n"
        f"```mermaid\nstateDiagram-v2\n    [*] --> IDLE\n{drawing}```\n\n"
        f"| event | | in | leads to | actions |\n|---|---|---|---|---|\n{_rows()}\n{END}"
    )


def _rows() -> str:
    text = ""
    for event in Event:
        steps: dict[tuple[str, str], list[State]] = {}
        for state, row in TABLE.items():
            if event in row:
                target, actions = row[event]
                goal = "" if target is state else target.name
                steps.setdefault((goal, ", ".join(action.name for action in actions)), []).append(state)
        for number, ((goal, performed), states) in enumerate(steps.items()):
            name = "| " if number else f"{event.name} | {event.value}"
            text += f"| {name} | {_list(states)} | {goal} | {performed} |\n"
    return text


def _list(states: list[State]) -> str:
    missing = [state.name for state in ACTIVE if state not in states]
    if len(missing) > 2 or len(states) < len(ACTIVE) - 2:
        return ", ".join(state.name for state in states)
    others = [state.name for state in states if state not in ACTIVE]
    return ", ".join(["every state but " + ", ".join(["IDLE", "OVER", *missing]), *others])


def main() -> None:
    """Replace the text between the markers of the page by the current states."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN, 1)
    PAGE.write_text(before + write_states() + rest.split(END, 1)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
