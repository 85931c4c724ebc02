"""Invariants of the library, checked over random schedules of faults in virtual time.

``python -m tests.invariants --schedules 2000 --seed 1`` runs 2000 schedules.  A workload performs operations and
records their results (``schedule.Workload``); ``sim.team.checker`` checks them.  For each failed schedule the command
prints the line that replays it, and the line of its smallest variant that still fails: the fewest faults (``--keep``),
no weather (``--calm``), the fewest workloads (``--only``), the shortest time (``--seconds``).

``--log FILE --resume`` adds the results to a seed log, and skips the seeds in it; Ctrl-C ends the run after the present
schedule.  ``--scheduler ADDRESS`` runs on the workers of a Dask scheduler (the extra ``sweep``).  ``--bugs`` runs with
each seeded bug in turn, which the schedules must detect.
"""
