"""Fault injection into a simulated team; the faults of a running node are in ``middleware.faults``.

``settings``: the faults of a scenario.  ``injector``: carries them out.  ``barrier``: which datagrams a partition
stops.  ``timeline``: random faults with a beginning and an end, in the order in which they are due.
"""
