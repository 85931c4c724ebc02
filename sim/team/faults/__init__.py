"""Fault injection into a simulated team; the faults of a running node are in ``middleware.faults``.

``settings`` defines the faults of a scenario, ``injector`` applies them. ``barrier`` selects the datagrams that a
partition blocks. ``timeline`` orders random faults by the times of their starts and ends.
"""
