"""An emulated internet of network namespaces: sites behind NAT routers, impaired links, and real nodes."""
