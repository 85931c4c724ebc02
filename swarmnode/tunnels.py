"""Creation of a node's network with or without tunnels."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from twisted.logger import Logger

from middleware.config.settings import NodeSettings
from middleware.entangled.network.network import Network
from middleware.entangled.network.url import Proxy, Url

_log = Logger()


def add_tunnels(
    settings: NodeSettings,
    udp: Callable[[], Network],
    reactor: Any,
    rng: random.Random,
    environment: Mapping[str, str],
) -> Callable[[], Network]:
    """Return the factory of a network with UDP and tunnels, or ``udp`` itself if there are no tunnels."""
    urls = settings.tunnel_urls
    if not (urls or settings.tunnel_port):
        return udp
    from middleware.entangled.network.combined_network import JointNetwork
    from middleware.entangled.network.tcp import TcpTransport
    from middleware.entangled.network.tunnel import TunnelNetwork

    host = settings.host if settings.tunnel_tls else "127.0.0.1"
    is_served, is_plain = settings.tunnel_port > 0, not settings.tunnel_tls
    proxies = partial(find_proxy, environment)

    def joint() -> Network:
        carrier = TcpTransport(reactor, host, settings.tunnel_port)
        return JointNetwork(udp(), TunnelNetwork(carrier, reactor, rng, urls, is_served, is_plain, proxies))

    return joint


def find_proxy(environment: Mapping[str, str], url: Url) -> Proxy | None:
    """Return the HTTP proxy that ``https_proxy`` and ``no_proxy`` set for ``url``, or None without a proxy."""
    proxy = environment.get("https_proxy") or environment.get("HTTPS_PROXY") or ""
    excluded = environment.get("no_proxy") or environment.get("NO_PROXY") or ""
    for name in (word.strip().lstrip(".") for word in excluded.split(",")):
        if name and (name == "*" or url.host == name or url.host.endswith("." + name)):
            return None
    try:
        return Proxy.parse(proxy) if proxy and url.is_tls else None
    except ValueError as error:
        _log.warn("https_proxy is ignored: {error}", error=error)
        return None
