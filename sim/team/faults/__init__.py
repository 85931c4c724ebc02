"""Fault injection into a simulated team; the faults of a running node are in ``middleware.faults``.

``settings``: the faults of a scenario.  ``injector``: applies them.  ``barrier``: selects the datagrams that a
partition stops.  ``timeline``: random faults with a start and an end, in the order in which they are due.
"""
