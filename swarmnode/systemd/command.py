"""``swarm service``: install, show, restart and remove a node as a systemd service.

Root installs a system service with a dynamic user and minimal permissions; another user installs a service of the
user's manager.  For a system service the settings and the files that they name are copied to the service's folder.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TextIO

from middleware.config.settings import IN_MEMORY, Settings
from middleware.entangled.control.conversion import remove_control_characters
from middleware.errors import SwarmError
from swarmnode.systemd.unit import MEMORY_LIMIT, PREFIX, SETTINGS_FILE, Unit, make_unit

DONE, FAILED, WRONG = 0, 1, 2
RunCommand = Callable[[Sequence[str]], int]


class CannotInstall(SwarmError):
    """The service cannot be installed; the message has the reason and the remedy."""


def run_command(words: Sequence[str]) -> int:
    """Run a systemd command; returns its exit code, 127 if it does not exist."""
    try:
        return subprocess.run(words, check=False).returncode  # noqa: S603 (ours, with no shell)
    except OSError:
        return 127


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    main_parser = argparse.ArgumentParser(
        prog="swarm service",
        description="Run a node as a systemd service.",
        epilog="Example: swarm service install dog1.toml",
    )
    verbs = main_parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, purpose in (
        ("install", "Install and start the service, or update its settings."),
        ("show", "Print the unit file, without changes."),
    ):
        example = f"Example: swarm service {name} dog1.toml"
        verb = verbs.add_parser(name, help=purpose, description=purpose, epilog=example)
        verb.add_argument("settings", metavar="SETTINGS", help="settings file of the node")
        verb.add_argument("--user", action="store_true", help="service of this user, without root")
        verb.add_argument(
            "--memory", default=MEMORY_LIMIT, metavar="SIZE", help=f"memory limit (default: {MEMORY_LIMIT})"
        )
        verb.add_argument("--no-start", action="store_true", help="write the files, but do not call systemd")
    for name, purpose in (
        ("restart", "Restart the service, for example after an upgrade."),
        ("remove", "Stop and remove the service; its data stays."),
    ):
        verb = verbs.add_parser(name, help=purpose, description=purpose, epilog=f"Example: swarm service {name} dog1")
        verb.add_argument("name", metavar="NAME", help="name of the node")
        verb.add_argument("--user", action="store_true", help="service of this user, without root")
    return main_parser


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    root: Path = Path("/"),
    uid: int | None = None,
    run: RunCommand = run_command,
    executable: str = sys.executable,
    can_enter: Callable[[Path], bool] = lambda folder: bool(folder.stat().st_mode & 0o001),
) -> int:
    """Run the command; returns 0, 1 if systemd failed, 2 if the command or the settings are wrong."""
    out = out or sys.stdout
    options = make_parser().parse_args(words)
    is_user = options.user or (os.getuid() if uid is None else uid) != 0
    try:
        if options.verb in ("restart", "remove"):
            return _Service(options.name, is_user, root, run, out).apply(options.verb)
        program, interpreter = find_twistd(executable, is_user, can_enter), str(_resolve_interpreter(executable))
        settings = Settings.load(str(Path(options.settings).absolute()))
        unit = make_unit(settings, program, is_user, options.memory, interpreter)
        if options.verb == "show":
            out.write(unit.text)
            return DONE
        return _Service(unit.name, is_user, root, run, out).install(unit, is_started=not options.no_start)
    except (SwarmError, OSError) as problem:
        sys.stderr.write(remove_control_characters(f"swarm service: {problem}") + "\n")
        return WRONG


def find_twistd(executable: str, is_user: bool, can_enter: Callable[[Path], bool]) -> str:
    """Return ``twistd`` of this environment; raises ``CannotInstall`` if the service's user cannot run it."""
    path = Path(executable).with_name("twistd")
    if not path.exists():
        raise CannotInstall(f"{path} does not exist; install swarm-node into this Python environment")
    folders = [] if is_user else [*path.parents, *_resolve_interpreter(executable).parents]
    for folder in folders:
        if not can_enter(folder):
            remedy = "create an environment below /opt with the system's Python, or use --user"
            raise CannotInstall(f"other users cannot enter {folder}, which this program needs; {remedy}")
    return str(path)


def _resolve_interpreter(executable: str) -> Path:
    """Return the real path of the interpreter, which is often a symbolic link in a virtual environment."""
    return Path(executable).resolve()


class _Service:
    """The files of one node's service, and the calls to systemd."""

    def __init__(self, name: str, is_user: bool, root: Path, run: RunCommand, out: TextIO) -> None:
        home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        units = home / "systemd/user" if is_user else Path("/etc/systemd/system")
        self._label = PREFIX + name
        self._unit = root / units.relative_to("/") / f"{self._label}.service"
        # At the first start systemd moves this folder below `private`, and replaces it by a link.
        self._state = root / "var/lib" / self._label
        self._is_user = is_user
        self._run_command = run
        self._out = out

    def install(self, unit: Unit, is_started: bool) -> int:
        """Write the unit and its files, and start it."""
        if not self._is_user:
            self._copy_settings(unit.settings)
        self._unit.parent.mkdir(parents=True, exist_ok=True)
        _write_atomically(self._unit, unit.text.encode(), 0o644)
        self._out.write(f"{self._unit}\n")
        if not is_started:
            return DONE
        for words in (("daemon-reload",), ("enable", self._label), ("restart", self._label)):
            if self._systemctl(*words) != DONE:
                return self._report_failure()
        if self._is_user:
            self._out.write("The service stops when you sign out, unless you run: loginctl enable-linger\n")
        return DONE

    def apply(self, verb: str) -> int:
        """Restart or remove the service; raises ``CannotInstall`` if it is not installed."""
        if not self._unit.exists():
            raise CannotInstall(f"{self._unit} does not exist; install it by: swarm service install SETTINGS")
        if verb == "restart":
            return DONE if self._systemctl("restart", self._label) == DONE else self._report_failure()
        ended = self._systemctl("disable", "--now", self._label)
        self._unit.unlink()
        self._systemctl("daemon-reload")
        kept = "" if self._is_user else f"; its data stays in {self._state}"
        self._out.write(f"removed {self._unit}{kept}\n")
        return DONE if ended == DONE else FAILED

    def _copy_settings(self, path: str) -> None:
        """Copy the settings, and the files that they refer to, to the service's folder; keep files that exist there."""
        settings, folder = Settings.load(path), Path(path).parent
        self._state.mkdir(mode=0o700, parents=True, exist_ok=True)
        named = [settings.node.store, settings.node.membership]
        for file in [Path(each) for each in named if each and each != IN_MEMORY]:
            try:
                inside = file.relative_to(folder)
            except ValueError:
                raise CannotInstall(
                    f"{file} is outside of {folder}, where the service cannot write; use a path without a folder"
                ) from None
            for each in (file, *(file.with_name(file.name + ending) for ending in ("-wal", "-shm"))):
                target = self._state / inside.with_name(each.name)
                if each.exists() and not target.exists():
                    target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                    shutil.copyfile(each, target)
                    target.chmod(0o600)
        _write_atomically(self._state / SETTINGS_FILE, Path(path).read_bytes(), 0o600)
        self._set_owner()

    def _set_owner(self) -> None:
        """Set the folder's owner on its files, because systemd does so only when it creates the user."""
        owner = self._state.stat()
        for file in self._state.rglob("*"):
            if os.getuid() == 0:
                os.chown(file, owner.st_uid, owner.st_gid, follow_symlinks=False)

    def _systemctl(self, *words: str) -> int:
        return self._run_command(["systemctl", *(["--user"] if self._is_user else []), *words])

    def _report_failure(self) -> int:
        user = "--user " if self._is_user else ""
        sys.stderr.write(f"swarm service: systemctl failed; see: journalctl {user}-u {self._label} -n 30\n")
        return FAILED


def _write_atomically(path: Path, data: bytes, mode: int) -> None:
    """Write a file atomically."""
    new = path.with_name(path.name + ".new")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
    new.chmod(mode)
    new.replace(path)
