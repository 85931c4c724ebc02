"""The page: what the node's data store knows, and an operator's wishes on their way back.

``state`` makes the view, ``app`` is the Flask side (page and JSON), ``live`` the native streams (state and cameras),
``server`` puts both on one port inside Twisted, ``desk`` is what an operator can ask for.  This room knows no robot
and no peer.
"""
