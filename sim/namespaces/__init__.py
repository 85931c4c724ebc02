"""An internet made of network namespaces: sites behind routers that translate addresses, bad lines, and real nodes."""
