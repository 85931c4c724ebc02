"""The control socket: how programs in any language, and people at a shell, speak to the node of their machine."""
