"""The invariants: functions that yield the violations in a history, one line each."""
