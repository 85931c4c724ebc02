"""Ballast: what Twisted loads because it is installed, and what a process that speaks no TLS leaves ashore."""

from __future__ import annotations

import sys


def drop_tls() -> None:
    """Have Twisted find no pyOpenSSL: it would load that into every process with a reactor, and it weighs 13 MiB.

    Call this before the reactor is imported; where pyOpenSSL is loaded already, nothing is changed.
    """
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]
