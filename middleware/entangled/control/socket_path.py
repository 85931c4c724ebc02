"""Location of the control sockets of this machine's nodes: one file per node, accessible only to its user.

Any user may create a folder, a link or a socket in ``/tmp``, so node and client check the owner of each.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from middleware.entangled.errors import LocalError

FOLDER_NAME = "swarm-node"
SUFFIX = ".control"
MAX_PATH_BYTES = 107
"""Maximum bytes of the path of a UNIX socket (``sockaddr_un``, Linux)."""


class NoControl(LocalError):
    """The control socket does not exist, cannot be created, or is unsafe."""


def find_folder() -> Path:
    """Return the folder of the sockets: in ``XDG_RUNTIME_DIR``, otherwise in ``/tmp`` with the user's id."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / FOLDER_NAME if runtime else Path(f"/tmp/{FOLDER_NAME}-{os.getuid()}")


def prepare_path(name: str) -> Path:
    """Create the folder and return the path for the socket of node ``name``; raise ``NoControl`` if unsafe."""
    directory = find_folder()
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise NoControl(f"cannot create {directory} for the control socket: {error.strerror}") from error
    if check_owner(directory) != os.getuid():
        raise _make_unsafe_error(directory)
    path = directory / f"{name}{SUFFIX}"
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise NoControl(
            f"{path} has more than {MAX_PATH_BYTES} bytes, the limit for a socket; set a shorter XDG_RUNTIME_DIR"
        )
    return path


def list_files(ending: str) -> list[Path]:
    """Return the files with that ending in the folder, sorted; raise ``NoControl`` if the folder is unsafe."""
    if os.path.lexists(find_folder()):
        check_owner(find_folder())
    return sorted(find_folder().glob(f"*{ending}"))


def find_socket(name: str | None) -> Path:
    """Return the socket of node ``name`` (None: the only node); ``NoControl`` contains the existing names."""
    names = [path.name.removesuffix(SUFFIX) for path in list_files(SUFFIX)]
    if name is None and len(names) == 1:
        name = names[0]
    if name in names:
        return find_folder() / f"{name}{SUFFIX}"
    if not names:
        raise NoControl("no node runs on this machine; start one: twistd -n swarm-node --name NAME")
    existing = ", ".join(names)
    if name is None:
        raise NoControl(f"several nodes have run on this machine; choose one with --node NAME: {existing}")
    raise NoControl(f"no node {name!r} runs on this machine; nodes that have run: {existing}")


def check_socket(path: Path) -> None:
    """Raise ``NoControl`` if ``path`` is not a socket, or has a different owner than its folder."""
    owner = check_owner(path.parent)
    try:
        state = path.lstat()
    except OSError as error:
        reason = error.strerror
        raise NoControl(
            f"the node of {path} does not answer ({reason}); start the node, or remove this file"
        ) from error
    if not stat.S_ISSOCK(state.st_mode):
        raise NoControl(f"{path} is not a socket; remove this file and restart the node")
    if state.st_uid != owner:
        raise _make_unsafe_error(path)


def check_owner(path: Path) -> int:
    """Return the user id of the folder ``path``; raise ``NoControl`` if other users have access.

    The owner must be this user.  For root the owner may also be the user of a service, if ``XDG_RUNTIME_DIR`` is set to
    the service's folder.
    """
    try:
        state = path.lstat()
    except OSError as error:
        raise NoControl(f"cannot use {path} for the control socket: {error.strerror}") from error
    is_served = os.getuid() == 0 and bool(os.environ.get("XDG_RUNTIME_DIR"))
    is_trusted = state.st_uid == os.getuid() or is_served
    if not stat.S_ISDIR(state.st_mode) or state.st_mode & 0o077 or not is_trusted:
        raise _make_unsafe_error(path)
    return state.st_uid


def _make_unsafe_error(path: Path) -> NoControl:
    return NoControl(f"{path} is accessible to other users; remove it, or set XDG_RUNTIME_DIR to a private folder")
