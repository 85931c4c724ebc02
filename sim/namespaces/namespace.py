"""Create network namespaces, each held open by a process.

A namespace has no name that other processes could see. The namespace and its interfaces exist until the process that
holds it ends. The holder ends when its standard input is closed, so nothing remains however this process ends, and two
runs cannot conflict. Without privileges, the first namespace is created in a new user namespace, which contains all
others.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence

TOOLS = {
    "unshare": "util-linux",
    "nsenter": "util-linux",
    "setpriv": "util-linux",
    "ip": "iproute2",
    "nft": "nftables",
    "conntrack": "conntrack",
    "ethtool": "ethtool",
}
"""The required tools, with their Debian packages."""
PATH = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))
"""PATH with the sbin folders, which users other than root often lack; the tools work in a user namespace."""
OWN_USER_FLAGS = ("--user", "--map-root-user")
SCRIPT_LIMIT_S = 20.0


class NamespacesUnavailable(Exception):
    """This machine does not allow network namespaces; the message has the reason and the remedy."""


class Namespace:
    """A network namespace, in the user namespace of ``inside``; None for the first namespace.

    Raises ``NamespacesUnavailable``.
    """

    def __init__(self, inside: Namespace | None = None) -> None:
        self._is_own_user: bool = inside is not None and inside._is_own_user
        before = () if inside is None else inside.entry_command
        prefixes: list[Sequence[str]] = (
            [()] if inside is not None else [(), OWN_USER_FLAGS] if not os.geteuid() else [OWN_USER_FLAGS]
        )
        error_text = ""
        for prefix in prefixes:
            started = _start_holder([*before, "unshare", *prefix, "--net", "sh", "-c", "echo; exec cat"])
            if isinstance(started, str):
                error_text = started
                continue
            self._holder = started
            self._is_own_user |= prefix is OWN_USER_FLAGS
            return
        raise NamespacesUnavailable(f"cannot create a network namespace: {error_text}; {_find_remedy()}")

    @property
    def pid(self) -> int:
        """The id of the process that holds the namespace."""
        return self._holder.pid

    @property
    def entry_command(self) -> tuple[str, ...]:
        """The command prefix that runs a program in the namespace."""
        user = ("--user", "--preserve-credentials") if self._is_own_user else ()
        return ("nsenter", f"--target={self.pid}", *user, "--net", "--")

    @property
    def inner_entry_command(self) -> tuple[str, ...]:
        """The command prefix for a process that is already in another namespace of the same internet."""
        return ("nsenter", f"--target={self.pid}", "--net", "--")

    def command(self, arguments: Sequence[str]) -> list[str]:
        """Return the command that runs ``arguments`` in the namespace; the command ends when this process ends."""
        # The parent may end before PDEATHSIG is set.
        checked = ("sh", "-c", '[ "$PPID" = "$0" ] && exec "$@"', str(os.getpid()))
        return [*self.entry_command, "setpriv", "--pdeathsig=KILL", "--", *checked, *arguments]

    def run(self, script: str) -> str:
        """Run a shell script in the namespace and return its output; raise ``RuntimeError`` if a command fails."""
        done = subprocess.run(
            [*self.entry_command, "sh", "-e"],
            input=script,
            capture_output=True,
            text=True,
            timeout=SCRIPT_LIMIT_S,
            env=make_environment(),
        )
        if done.returncode:
            raise RuntimeError(f"in a namespace: {done.stderr.strip() or done.stdout.strip()}\n{script}")
        return done.stdout

    def close(self) -> None:
        """Remove the namespace; may be called repeatedly."""
        self._holder.kill()
        self._holder.wait()
        for pipe in (self._holder.stdin, self._holder.stdout, self._holder.stderr):
            if pipe is not None:
                pipe.close()


def make_environment() -> dict[str, str]:
    """Return the environment of this process with the sbin folders in PATH."""
    return {**os.environ, "PATH": PATH}


def find_unavailable_reason() -> str:
    """Return the reason why namespaces are not available on this machine; empty if they are available."""
    missing = sorted({package for tool, package in TOOLS.items() if shutil.which(tool, path=PATH) is None})
    if missing:
        return f"required tools are missing; install them: apt install {' '.join(missing)}"
    try:
        first = Namespace()
    except NamespacesUnavailable as error:
        return str(error)
    try:
        # A container may allow namespaces, but forbid these operations.
        first.run("ip link add probe type veth\nip link del probe\nnft list ruleset >/dev/null\n")
    except RuntimeError as error:
        return f"namespaces are allowed, but the required operations in a namespace are not: {error}"
    finally:
        first.close()
    return ""


def _start_holder(command: list[str]) -> subprocess.Popen[str] | str:
    """Return the holder when it has entered its namespace, or its error output if it failed."""
    pipe = subprocess.PIPE
    try:
        holder = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=make_environment())
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    assert holder.stdout is not None
    if holder.stdout.readline():
        return holder
    return holder.communicate()[1].strip() or "it ended without an error message"


def _find_remedy() -> str:
    if not os.geteuid():
        return "in a container the capability SYS_ADMIN is required (docker run --cap-add SYS_ADMIN ..)"
    knobs = (
        "user.max_user_namespaces",
        "kernel.unprivileged_userns_clone",
        "kernel.apparmor_restrict_unprivileged_userns",
    )
    return f"run as root, or allow users to create namespaces (sysctl {', '.join(knobs)})"
