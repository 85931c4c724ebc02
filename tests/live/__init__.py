"""Tests with real sockets, processes and browsers."""

import signal

# A job in the background is given an ignored Ctrl-C, and so would the programs be that are sent one here.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
