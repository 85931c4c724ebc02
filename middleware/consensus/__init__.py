"""How agents decide: strategies say who should act, bids carry their reports, and a lease says who may act.

``strategy`` is the interface of strategies and ``strategies`` has the built-in ones; ``bidding`` carries reports to the
council of a task and its announcement back; ``lease`` grants the right to act.
"""
