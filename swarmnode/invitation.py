"""Invitation: where the page of a node of this machine is and how to sign in there, in a note and at a terminal.

The note lies beside the node's control socket, for the eyes of the node's user alone; ``swarm web`` reads it.  The log,
which is kept, sent on and read by others, says where the page is and never how to sign in.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TextIO

from twisted.logger import Logger

from middleware.entangled.control.place import NoControl, files, made
from webnode.keyfile import keep

ENDING = ".page"
ANY = ("0.0.0.0", "::")

_log = Logger()


@dataclass(frozen=True)
class Invitation:
    """The page of the node ``name``: ``pid`` is the node's process, ``code`` is empty where nobody needs to sign in.

    ``secure`` is the page's address over TLS, empty where there is none.
    """

    name: str
    url: str
    code: str
    pid: int
    secure: str = ""

    @property
    def link(self) -> str:
        """The address that signs in by itself; what stands behind the ``#`` is never sent."""
        return f"{self.url}#code={self.code}" if self.code else self.url


def url_of(host: str, port: int, scheme: str = "http") -> str:
    """The address of a page, for a browser of this machine."""
    here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"{scheme}://[{here}]:{port}/" if ":" in here else f"{scheme}://{here}:{port}/"


def invited(
    name: str, host: str, port: Callable[[], int], code: str, secure_port: int = 0, terminal: TextIO | None = None
) -> None:
    """Say in the log where the page is, and leave the note; where none can be left, the log says why.

    ``terminal`` is where a person looks on who may know the code.
    """
    secure = url_of(host, secure_port, "https") if secure_port else ""
    invitation = Invitation(name, url_of(host, port()), code, os.getpid(), secure)
    how = "; the command swarm web tells how to sign in" if code else "; whoever opens it is an operator"
    also = f", and over TLS at {secure}" if secure else ""
    _log.info("the page is at {url}{also}{how}", url=invitation.url, also=also, how=how)
    if code and terminal is not None:
        terminal.write(f"{name}: sign in with the code {code}, or open {invitation.link}\n")
        terminal.flush()
    try:
        keep(made(name).with_suffix(ENDING), json.dumps(asdict(invitation)).encode())
    except (NoControl, OSError) as error:
        _log.warn("swarm web will not know of the page: {error}", error=error)


def at_terminal() -> TextIO | None:
    """The terminal from which this process was started, where there is one and it is no log."""
    # Once twistd logs, what is written to sys.stderr ends up in the log.
    stream = sys.__stderr__
    try:
        return stream if stream is not None and stream.isatty() else None
    except ValueError:  # closed by a daemon
        return None


def invitations() -> list[Invitation]:
    """The pages of this machine whose nodes run, by name; raises ``NoControl`` where another user made the folder."""
    found = []
    for path in files(ENDING):
        try:
            invitation = Invitation(**json.loads(path.read_text(encoding="utf-8")))
            os.kill(invitation.pid, 0)
        except (OSError, ValueError, TypeError):
            continue
        found.append(invitation)
    return found
