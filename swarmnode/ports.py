"""Selection of a free port if the default port is in use, so several nodes can run on one machine."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import replace

from twisted.logger import Logger

from middleware.config.settings import Settings

PORT_COUNT = 8
"""Number of ports to try from the default on: few, so a firewall can allow them.  After these, any port is used."""

IsFree = Callable[[socket.SocketKind, str, int], bool]
_log = Logger()


def is_free(kind: socket.SocketKind, host: str, port: int) -> bool:
    """Return whether a program could listen on ``port`` now; True for an invalid ``host``, which is reported later."""
    try:
        found = socket.getaddrinfo(host or None, port, type=kind, flags=socket.AI_PASSIVE)
        with socket.socket(found[0][0], kind) as tried:
            if kind == socket.SOCK_STREAM:
                # Like the real listener, treat a port in TIME_WAIT as free.
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind(found[0][4])
    except OSError as error:
        return "in use" not in str(error)
    return True


def replace_busy_ports(settings: Settings, is_free: IsFree = is_free) -> Settings:
    """Replace each default port that is in use by a free port; ports that were set do not change."""
    node, web = settings.node, settings.web
    if not settings.is_given("node", "port"):
        host = "" if node.host == "*" else node.host
        node = replace(node, port=_select_port("[node] port", socket.SOCK_DGRAM, host, node.port, is_free))
    if "web" in node.roles:
        if not settings.is_given("web", "port"):
            web = replace(web, port=_select_port("[web] port", socket.SOCK_STREAM, web.host, web.port, is_free))
        if web.tls and not settings.is_given("web", "tls_port"):
            tls_port = _select_port("[web] tls_port", socket.SOCK_STREAM, web.host, web.tls_port, is_free)
            web = replace(web, tls_port=tls_port)
    return replace(settings, node=node, web=web)


def _select_port(key: str, kind: socket.SocketKind, host: str, usual: int, is_free: IsFree) -> int:
    for port in range(usual, usual + PORT_COUNT):
        if is_free(kind, host, port):
            if port != usual:
                _log.info("{key}: {usual} is in use; using {port}", key=key, usual=usual, port=port)
            return port
    last = usual + PORT_COUNT - 1
    _log.info("{key}: {usual} to {last} are in use; using any free port", key=key, usual=usual, last=last)
    return 0
