"""Room: a network namespace that one process holds open.

Nothing gets a name that others on the machine could see: a room is its holder, ends with it, and takes its interfaces
along.  The holder ends at the end of its input, so however we end, a kill included, nothing is left; and two runs
cannot meet.  Without privilege the first room gets a user namespace of its own, in which all others lie.
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
"""What is called, and the Debian package that has it."""
PATH = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))
"""Whoever is not root often has no administrator's tools on the path; in a user namespace they serve all the same."""
OWN_USER = ("--user", "--map-root-user")
SCRIPT_S = 20.0


class Refused(Exception):
    """This machine lets us make no network namespaces; says why, and what to do."""


class Room:
    """One namespace; ``inside`` is the room in whose user namespace it lies (None: the first).  Raises ``Refused``."""

    def __init__(self, inside: Room | None = None) -> None:
        self._is_own_user: bool = inside is not None and inside._is_own_user
        before = () if inside is None else inside.entry
        ways: list[Sequence[str]] = [()] if inside is not None else [(), OWN_USER] if not os.geteuid() else [OWN_USER]
        said = ""
        for way in ways:
            held = _held([*before, "unshare", *way, "--net", "sh", "-c", "echo; exec cat"])
            if isinstance(held, str):
                said = held
                continue
            self._holder = held
            self._is_own_user |= way is OWN_USER
            return
        raise Refused(f"no network namespace can be made here: {said}; {_remedy()}")

    @property
    def pid(self) -> int:
        """The process that holds it."""
        return self._holder.pid

    @property
    def entry(self) -> tuple[str, ...]:
        """What stands before a command that is to run in the room."""
        user = ("--user", "--preserve-credentials") if self._is_own_user else ()
        return ("nsenter", f"--target={self.pid}", *user, "--net", "--")

    @property
    def inner_entry(self) -> tuple[str, ...]:
        """The same for a process that is in another room of the same internet already."""
        return ("nsenter", f"--target={self.pid}", "--net", "--")

    def command(self, arguments: Sequence[str]) -> list[str]:
        """``arguments`` as a command that runs in the room; it is to be started by this process, and ends with it."""
        # We may be gone before the kernel was told what to do then.
        checked = ("sh", "-c", '[ "$PPID" = "$0" ] && exec "$@"', str(os.getpid()))
        return [*self.entry, "setpriv", "--pdeathsig=KILL", "--", *checked, *arguments]

    def run(self, script: str) -> str:
        """Run a shell script in the room, to its first fault; returns what it said; raises ``RuntimeError``."""
        done = subprocess.run(
            [*self.entry, "sh", "-e"], input=script, capture_output=True, text=True, timeout=SCRIPT_S, env=environment()
        )
        if done.returncode:
            raise RuntimeError(f"in a namespace: {done.stderr.strip() or done.stdout.strip()}\n{script}")
        return done.stdout

    def close(self) -> None:
        """End the room; may be called twice."""
        self._holder.kill()
        self._holder.wait()
        for pipe in (self._holder.stdin, self._holder.stdout, self._holder.stderr):
            if pipe is not None:
                pipe.close()


def environment() -> dict[str, str]:
    """Ours, with the places of administrators' tools on the path."""
    return {**os.environ, "PATH": PATH}


def refusal() -> str:
    """Why no internet can be made here; empty where it can."""
    missing = sorted({package for tool, package in TOOLS.items() if shutil.which(tool, path=PATH) is None})
    if missing:
        return f"tools are missing; install them: apt install {' '.join(missing)}"
    try:
        first = Room()
    except Refused as error:
        return str(error)
    try:
        # What a container may forbid though it allows the namespace itself.
        first.run("ip link add probe type veth\nip link del probe\nnft list ruleset >/dev/null\n")
    except RuntimeError as error:
        return f"namespaces are allowed, what is needed in them is not: {error}"
    finally:
        first.close()
    return ""


def _held(command: list[str]) -> subprocess.Popen[str] | str:
    """The holder, once it is in its namespace; else what was said instead."""
    pipe = subprocess.PIPE
    try:
        holder = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment())
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    assert holder.stdout is not None
    if holder.stdout.readline():
        return holder
    return holder.communicate()[1].strip() or "it ended without a word"


def _remedy() -> str:
    if not os.geteuid():
        return "in a container they need the capability SYS_ADMIN (docker run --cap-add SYS_ADMIN ..)"
    knobs = (
        "user.max_user_namespaces",
        "kernel.unprivileged_userns_clone",
        "kernel.apparmor_restrict_unprivileged_userns",
    )
    return f"run as root, or let users make namespaces (sysctl {', '.join(knobs)})"
