"""Invariants of the library, checked over random schedules of faults on simulated time.

``python -m tests.invariants --schedules 2000 --seed 1`` runs that many.  A workload brings its operations and writes
down what came of them (``schedule.Workload``); ``sim.team.checker`` judges it.  Of each that fails it prints the line
that replays it, and that of the least which still fails so: the fewest faults (``--keep``), no weather (``--calm``),
the fewest workloads (``--only``), the shortest time (``--seconds``).

``--log FILE --resume`` adds what was run to a logbook, and leaves out what stands there; Ctrl-C ends it after the
present schedule.  ``--scheduler ADDRESS`` runs on the machines that wait there (the extra ``sweep``).  ``--bugs`` puts
in one bug after the other: each has to show.
"""
