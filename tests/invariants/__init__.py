"""Invariants of the library, checked over random schedules of faults on simulated time.

``python -m tests.invariants --schedules 2000 --seed 1`` runs that many and prints, for each that fails, the line that
replays it.  A workload brings its operations and its checks; see ``schedule.Workload``.
"""
