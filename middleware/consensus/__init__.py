"""Consensus: strategies choose the agent that should act; a quorum lease gives an agent the right to act.

``strategy`` is the interface of strategies and ``strategies`` has the built-in ones.  ``bidding`` carries reports to
the quorum members of a task and their announcement back.  ``lease`` grants the right to act.
"""
