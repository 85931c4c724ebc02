"""Confinement of the process that runs pushed code: irreversibly drop its privileges before the code runs.

On Linux the process cannot open files or sockets, or start processes or threads (seccomp with an allow list of system
calls).  It has an empty network namespace, no capabilities, no root privileges, and, if permitted, an empty root
folder.  It gets SIGKILL when its parent ends, and its memory and processor time are limited.  On other systems only
these limits apply.  ``confine`` returns the limits in effect.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import signal
import struct
import sys
from collections.abc import Callable
from contextlib import suppress

MEMORY_BYTES = 256 * 1024 * 1024
"""Bytes of address space in addition to the libraries."""
CPU_S = 3600
"""Maximum seconds of processor time of a process; it is then killed, and restarted at the next request."""
NOBODY_ID = 65534

_CLONE_NEWNET, _CLONE_NEWUSER, _CLONE_NEWIPC = 0x40000000, 0x10000000, 0x08000000
_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_NO_NEW_PRIVS = 1, 4, 38
_SECCOMP_SET_MODE_FILTER, _SECCOMP_FILTER_FLAG_TSYNC = 1, 1
_CAPABILITY_VERSION_3 = 0x20080522
_KILL, _ERRNO_EPERM, _ALLOW = 0x80000000, 0x00050001, 0x7FFF0000
_LOAD, _JUMP_EQUAL, _RETURN = 0x20, 0x15, 0x06
_NUMBER_AT, _ARCHITECTURE_AT = 0, 4

ALLOWED_CALLS = (
    *("read", "write", "close", "lseek", "mmap", "munmap", "mprotect", "mremap", "madvise", "brk"),
    *("rt_sigaction", "rt_sigprocmask", "rt_sigreturn", "sigaltstack", "restart_syscall"),
    *("futex", "set_robust_list", "rseq", "sched_yield", "getpid", "getrandom"),
    *("clock_gettime", "gettimeofday", "nanosleep", "clock_nanosleep", "exit", "exit_group"),
)
"""System calls that a module may make, on files that are already open; all other system calls fail with EPERM."""
_NUMBERS: dict[str, tuple[int, int, tuple[int, ...]]] = {
    # machine: architecture for seccomp, number of the system call seccomp, numbers of CALLS in their order
    "x86_64": (
        0xC000003E,
        317,
        (0, 1, 3, 8, 9, 11, 10, 25, 28, 12, 13, 14, 15, 131, 219)
        + (202, 273, 334, 24, 39, 318, 228, 96, 35, 230, 60, 231),
    ),
    "aarch64": (
        0xC00000B7,
        277,
        (63, 64, 57, 62, 222, 215, 226, 216, 233, 214, 134, 135, 139, 132, 128)
        + (98, 99, 293, 124, 172, 278, 113, 169, 101, 115, 93, 94),
    ),
}


def confine(parent: int) -> list[str]:
    """Drop all privileges that the system permits to drop; return the names of the limits in effect.

    ``parent`` is the id of the parent process; this process ends when the parent does.
    """
    held = ["limits"] if _set_limits() else []
    if not sys.platform.startswith("linux"):
        return held
    libc = ctypes.CDLL(None, use_errno=True)
    was_root = os.getuid() == 0
    steps: list[tuple[str, Callable[[], bool]]] = [
        ("no network", lambda: _leave_network(libc, was_root)),
        ("no files", _leave_files),
        ("no user", lambda: was_root and _become_nobody()),
        ("no capabilities", lambda: _drop_capabilities(libc)),
        ("no new rights", lambda: libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0),
        ("no tracing", lambda: libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0) == 0),
        ("ends with node", lambda: _end_with_parent(libc, parent)),
        ("seccomp", lambda: _install_filter(libc, platform.machine())),
    ]
    for name, step in steps:
        with suppress(OSError, ValueError, AttributeError):
            if step():
                held.append(name)
    return held


def build_filter(machine: str) -> bytes:
    """Return the seccomp program for ``machine``, as ``struct sock_filter``; raises ``ValueError`` if it is unknown."""
    if machine not in _NUMBERS:
        raise ValueError(f"no system call numbers for {machine}")
    architecture, _, numbers = _NUMBERS[machine]
    lines = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_JUMP_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER_AT),
        *((_JUMP_EQUAL, len(numbers) - place, 0, number) for place, number in enumerate(numbers)),
        (_RETURN, 0, 0, _ERRNO_EPERM),
        (_RETURN, 0, 0, _ALLOW),
    ]
    return b"".join(struct.pack("=HBBI", *line) for line in lines)


def _set_limits() -> bool:
    used = 0
    with suppress(OSError, ValueError, IndexError), open("/proc/self/statm", encoding="ascii") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    limits = {
        "RLIMIT_AS": used + MEMORY_BYTES,
        "RLIMIT_CPU": CPU_S,
        "RLIMIT_NOFILE": 0,
        "RLIMIT_NPROC": 0,
        "RLIMIT_FSIZE": 0,
        "RLIMIT_CORE": 0,
    }
    done = 0
    for name, most in limits.items():
        with suppress(OSError, ValueError, AttributeError):
            resource.setrlimit(getattr(resource, name), (most, most))
            done += 1
    return done == len(limits)


def _leave_network(libc: ctypes.CDLL, is_root: bool) -> bool:
    spaces = _CLONE_NEWNET | _CLONE_NEWIPC
    return bool(libc.unshare(spaces if is_root else spaces | _CLONE_NEWUSER) == 0)


def _leave_files() -> bool:
    os.chroot(".")
    os.chdir("/")
    return True


def _become_nobody() -> bool:
    os.setgroups([])
    os.setresgid(NOBODY_ID, NOBODY_ID, NOBODY_ID)
    os.setresuid(NOBODY_ID, NOBODY_ID, NOBODY_ID)
    return True


def _drop_capabilities(libc: ctypes.CDLL) -> bool:
    header = struct.pack("=Ii", _CAPABILITY_VERSION_3, 0)
    return bool(libc.capset(header, bytes(24)) == 0)


def _end_with_parent(libc: ctypes.CDLL, parent: int) -> bool:
    if libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        return False
    if os.getppid() != parent:
        os._exit(1)
    return True


def _install_filter(libc: ctypes.CDLL, machine: str) -> bool:
    program = ctypes.create_string_buffer(build_filter(machine))
    size = (len(program) - 1) // 8
    # struct sock_fprog: a count and, after padding, the address of the instructions.
    pointer = struct.pack("@HP", size, ctypes.addressof(program))
    _, call, _ = _NUMBERS[machine]
    return bool(libc.syscall(call, _SECCOMP_SET_MODE_FILTER, _SECCOMP_FILTER_FLAG_TSYNC, pointer) == 0)
