"""Start the demonstration: ``python -m sim.demo``."""

import sys

if __name__ == "__main__":
    # Twisted would load pyOpenSSL if it is installed (13 MiB), but nothing in this process uses TLS.
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]
    from sim.demo.demonstration import main

    main()
