"""Place: where the control sockets of this machine's nodes lie, one file a node, for its owner's eyes only.

In ``/tmp`` any user may make a folder, a link or a socket first.  So node and client check the owner of each.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from middleware.entangled.errors import LocalError

FOLDER = "swarm-node"
ENDING = ".control"
MAX_PATH = 107
"""Bytes of the path of a UNIX socket (``sockaddr_un``, Linux)."""


class NoControl(LocalError):
    """There is no such control socket, or none can be made."""


def folder() -> Path:
    """The folder of the sockets: in ``XDG_RUNTIME_DIR``, else in ``/tmp`` under the user's number."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / FOLDER if runtime else Path(f"/tmp/{FOLDER}-{os.getuid()}")


def made(name: str) -> Path:
    """The path for the socket of node ``name``, its folder made; raises ``NoControl`` where that is not safe."""
    where = folder()
    try:
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise NoControl(f"cannot make {where} for the control socket: {error.strerror}") from error
    if owner_of(where) != os.getuid():
        raise _foreign(where)
    path = where / f"{name}{ENDING}"
    if len(os.fsencode(path)) > MAX_PATH:
        raise NoControl(f"{path} is longer than the {MAX_PATH} bytes of a socket's path; set a shorter XDG_RUNTIME_DIR")
    return path


def files(ending: str) -> list[Path]:
    """The files of the nodes of this machine with that ending, by name; raises ``NoControl`` for a foreign folder."""
    if os.path.lexists(folder()):
        owner_of(folder())
    return sorted(folder().glob(f"*{ending}"))


def found(name: str | None) -> Path:
    """The socket of node ``name``, or of the only node here; raises ``NoControl``, which names those there are."""
    names = [path.name.removesuffix(ENDING) for path in files(ENDING)]
    if name is None and len(names) == 1:
        name = names[0]
    if name in names:
        return folder() / f"{name}{ENDING}"
    if not names:
        raise NoControl("no node runs on this machine; start one: twistd -n swarm-node --name NAME")
    there = ", ".join(names)
    if name is None:
        raise NoControl(f"several nodes have run on this machine; say which: --node NAME, one of {there}")
    raise NoControl(f"no node {name!r} runs on this machine; there are {there}")


def check_socket(path: Path) -> None:
    """Raise ``NoControl`` where ``path`` is no socket, or one of another user than its folder's."""
    owner = owner_of(path.parent)
    try:
        state = path.lstat()
    except OSError as error:
        why = error.strerror
        raise NoControl(f"the node behind {path} does not answer ({why}); start it, or remove that file") from error
    if not stat.S_ISSOCK(state.st_mode):
        raise NoControl(f"{path} is no socket; remove it, and start the node anew")
    if state.st_uid != owner:
        raise _foreign(path)


def owner_of(where: Path) -> int:
    """The user of the folder ``where``, in which no other user can make anything; raises ``NoControl``.

    That is this user, or for root the user of a service, where ``XDG_RUNTIME_DIR`` names its folder.
    """
    try:
        state = where.lstat()
    except OSError as error:
        raise NoControl(f"cannot use {where} for the control socket: {error.strerror}") from error
    is_served = os.getuid() == 0 and bool(os.environ.get("XDG_RUNTIME_DIR"))
    is_trusted = state.st_uid == os.getuid() or is_served
    if not stat.S_ISDIR(state.st_mode) or state.st_mode & 0o077 or not is_trusted:
        raise _foreign(where)
    return state.st_uid


def _foreign(path: Path) -> NoControl:
    return NoControl(f"{path} is not yours alone; remove it, or set XDG_RUNTIME_DIR to a folder of your own")
