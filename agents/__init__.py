"""The minds: observe, report, confer, execute, give back (thesis, Algorithm 4.5).

``loop`` turns observations into actions, ``engagement`` is one task from assignment to end, ``decision`` the pure rule
between; ``behaviour`` is what a kind of task looks like, with one file a behaviour beside it.
"""
