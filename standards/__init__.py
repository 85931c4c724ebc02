"""Standards: what the world outside has written down and more than one room speaks, as bytes in and bytes out.

``head`` is the head of HTTP, ``websocket`` the greeting and the frames of RFC 6455.  This room knows no robot and no
node, and imports nothing of the house.
"""
