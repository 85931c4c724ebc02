"""Invariants of the library, checked over random schedules of faults in virtual time.

``python -m tests.invariants --schedules 2000 --seed 1`` runs 2000 schedules. A workload performs operations and records
their results (``schedule.Workload``); ``sim.team.checker`` checks the results. For each failed schedule the program
prints two commands: one replays the whole schedule, the second replays its smallest variant that still fails. The
smallest variant has the fewest faults (``--keep``) and workloads (``--only``), the shortest time (``--seconds``), and
no random loss, duplication, reordering and jitter (``--calm``).

``--log FILE --resume`` appends the results to a seed log, and skips the seeds that the log already contains. Ctrl-C
ends the run after the present schedule. ``--scheduler ADDRESS`` uses the workers of a Dask scheduler (optional
dependency ``sweep``). ``--bugs`` runs the schedules with each seeded bug, one bug after the other; the schedules must
detect every bug.
"""
