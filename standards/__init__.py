"""Standards: formats of others that several packages use, as bytes in and bytes out.

``head`` is the head of HTTP, ``websocket`` one end of a WebSocket with limits, ``jpeg`` the size of a picture.  This
package knows no robot and no node, and imports nothing of the project.
"""
