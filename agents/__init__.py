"""Agents: observe, report, decide, execute and release for one device (thesis, Algorithm 4.5).

``loop`` turns observations into actions.  ``engagement`` is an agent's part in one task from joining to end, and
``decision`` is the pure decision rule. ``behaviour`` is the interface of behaviours; the other modules contain the
built-in behaviours.
"""
