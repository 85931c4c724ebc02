"""Starts the demonstration: ``python -m sim.demo``."""

import sys

if __name__ == "__main__":
    # Twisted would load pyOpenSSL where it is installed (13 MiB), and nothing in this process speaks TLS.
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]
    from sim.demo.demonstration import main

    main()
