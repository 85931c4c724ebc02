"""Emulate an internet with network namespaces: sites behind NAT routers, impaired links, and real nodes."""
