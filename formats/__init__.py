"""Formats that several packages read: bytes and tables in, checked values and bytes out.

``convert`` makes dataclasses of settings, options and scenarios by the constraints in their annotations, ``head`` is
the head of HTTP, ``websocket`` one end of a WebSocket with limits, ``jpeg`` the size of a picture.  ``drivers`` and
``middleware`` both use this package, and do not import each other; it imports nothing of the project.
"""
