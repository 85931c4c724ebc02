"""Address and sign-in code of a node's page, in a file and at the terminal.

The file is next to the node's control socket, readable for the node's user only; ``swarm web`` reads it.  The log
contains the address but never the code, because logs are kept, forwarded and read by others.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TextIO

from twisted.logger import Logger

from middleware.entangled.control.socket_path import NoControl, list_files, prepare_path
from webnode.keyfile import write_key_file

PAGE_FILE_SUFFIX = ".page"
ANY_HOSTS = ("0.0.0.0", "::")

_log = Logger()


@dataclass(frozen=True)
class PageAccess:
    """The page of the node ``name``: ``pid`` is the node's process, ``code`` is empty if no sign-in is needed.

    ``secure`` is the page's address over TLS, or empty.
    """

    name: str
    url: str
    code: str
    pid: int
    secure: str = ""

    @property
    def link(self) -> str:
        """The address with the sign-in code after the ``#``; browsers do not send that part to the server."""
        return f"{self.url}#code={self.code}" if self.code else self.url


def make_url(host: str, port: int, scheme: str = "http") -> str:
    """Return the address of a page for a browser on this machine."""
    here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"{scheme}://[{here}]:{port}/" if ":" in here else f"{scheme}://{here}:{port}/"


def announce_page(
    name: str, host: str, port: Callable[[], int], code: str, secure_port: int = 0, terminal: TextIO | None = None
) -> None:
    """Log the address of the page, and write its file; if the file cannot be written, log the reason.

    ``terminal`` is the terminal of a user who may see the code.
    """
    secure = make_url(host, secure_port, "https") if secure_port else ""
    invitation = PageAccess(name, make_url(host, port()), code, os.getpid(), secure)
    how = "; run swarm web to see the sign-in code" if code else "; no sign-in: anyone who opens it is an operator"
    also = f", and over TLS at {secure}" if secure else ""
    _log.info("the page is at {url}{also}{how}", url=invitation.url, also=also, how=how)
    if code and terminal is not None:
        terminal.write(f"{name}: sign in with the code {code}, or open {invitation.link}\n")
        terminal.flush()
    try:
        write_key_file(prepare_path(name).with_suffix(PAGE_FILE_SUFFIX), json.dumps(asdict(invitation)).encode())
    except (NoControl, OSError) as error:
        _log.warn("swarm web cannot show this page: {error}", error=error)


def find_terminal() -> TextIO | None:
    """Return the terminal from which this process was started; None without a terminal or if stderr is a log."""
    # twistd redirects sys.stderr to its log.
    stream = sys.__stderr__
    try:
        return stream if stream is not None and stream.isatty() else None
    except ValueError:  # closed by daemonization
        return None


def list_pages() -> list[PageAccess]:
    """Return the pages of running nodes on this machine; raises ``NoControl`` if another user owns the folder."""
    found = []
    for path in list_files(PAGE_FILE_SUFFIX):
        try:
            invitation = PageAccess(**json.loads(path.read_text(encoding="utf-8")))
            os.kill(invitation.pid, 0)
        except (OSError, ValueError, TypeError):
            continue
        found.append(invitation)
    return found
