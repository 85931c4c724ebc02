"""The web page of a node: the state of the team, and the HTTP API through which operators change it.

``state`` builds the view, ``app`` serves the page and JSON with Flask, ``live`` serves the native streams (state and
cameras), ``server`` puts both on one port inside Twisted, and ``team_control`` carries out an operator's requests.
This package does not depend on robots or peers.
"""
