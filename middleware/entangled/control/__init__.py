"""The control socket: access to the node of the same machine for programs in any language and for the shell."""
