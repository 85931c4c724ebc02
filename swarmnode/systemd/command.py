"""Command: ``swarm service``, a node as a service of systemd: install, show, restart and remove it.

As root the node becomes a service of the system, under a user of its own and with little it may do; else one of the
user's own manager.  Its settings, and the files that they name, are copied into the service's own folder.
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
from middleware.entangled.control.word import printable
from middleware.errors import SwarmError
from swarmnode.systemd.unit import MEMORY, PREFIX, SETTINGS, Unit, unit_for

DONE, FAILED, WRONG = 0, 1, 2
Run = Callable[[Sequence[str]], int]


class CannotInstall(SwarmError):
    """The service cannot be installed so; the message says why and what to do."""


def run(words: Sequence[str]) -> int:
    """Run a command of systemd; returns its exit code, 127 where there is none."""
    try:
        return subprocess.run(words, check=False).returncode  # noqa: S603 (ours, with no shell)
    except OSError:
        return 127


def parser() -> argparse.ArgumentParser:
    """The command line."""
    whole = argparse.ArgumentParser(prog="swarm service", description="A node as a service of systemd.")
    verbs = whole.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, purpose in (
        ("install", "Install and start the service, or put new settings in its place."),
        ("show", "Print the unit, and change nothing."),
    ):
        verb = verbs.add_parser(name, help=purpose, description=purpose)
        verb.add_argument("settings", metavar="SETTINGS", help="the node's TOML file")
        verb.add_argument("--user", action="store_true", help="a service of your own, without root")
        verb.add_argument("--memory", default=MEMORY, metavar="SIZE", help=f"what it may have; {MEMORY} where not said")
        verb.add_argument("--no-start", action="store_true", help="leave systemd alone")
    for name, purpose in (
        ("restart", "Restart it, as after an upgrade; its team goes on meanwhile."),
        ("remove", "Stop and remove the service; what it stored stays."),
    ):
        verb = verbs.add_parser(name, help=purpose, description=purpose)
        verb.add_argument("name", metavar="NAME", help="the node's name")
        verb.add_argument("--user", action="store_true", help="a service of your own, without root")
    return whole


def main(
    words: Sequence[str] | None = None,
    out: TextIO | None = None,
    root: Path = Path("/"),
    uid: int | None = None,
    run: Run = run,
    executable: str = sys.executable,
    can_enter: Callable[[Path], bool] = lambda folder: bool(folder.stat().st_mode & 0o001),
) -> int:
    """Run the command; returns 0, 1 where systemd refused, 2 where the command or the settings are wrong."""
    out = out or sys.stdout
    wishes = parser().parse_args(words)
    is_user = wishes.user or (os.getuid() if uid is None else uid) != 0
    try:
        if wishes.verb in ("restart", "remove"):
            return _Place(wishes.name, is_user, root, run, out).do(wishes.verb)
        program, interpreter = twistd(executable, is_user, can_enter), str(_interpreter(executable))
        settings = Settings.load(str(Path(wishes.settings).absolute()))
        unit = unit_for(settings, program, is_user, wishes.memory, interpreter)
        if wishes.verb == "show":
            out.write(unit.text)
            return DONE
        return _Place(unit.name, is_user, root, run, out).install(unit, is_started=not wishes.no_start)
    except (SwarmError, OSError) as problem:
        sys.stderr.write(printable(f"swarm service: {problem}") + "\n")
        return WRONG


def twistd(executable: str, is_user: bool, can_enter: Callable[[Path], bool]) -> str:
    """The program beside this interpreter; raises ``CannotInstall`` where the service's user could not run it."""
    path = Path(executable).with_name("twistd")
    if not path.exists():
        raise CannotInstall(f"{path} is not there; install swarm-node into the environment that runs this")
    folders = [] if is_user else [*path.parents, *_interpreter(executable).parents]
    for folder in folders:
        if not can_enter(folder):
            remedy = "make an environment below /opt with the system's Python, or say --user"
            raise CannotInstall(f"other users cannot enter {folder}, which this program needs; {remedy}")
    return str(path)


def _interpreter(executable: str) -> Path:
    """The Python that runs: the interpreter of an environment is often a link to another one."""
    return Path(executable).resolve()


class _Place:
    """Where the service of one node lies, and how systemd is told of it."""

    def __init__(self, name: str, is_user: bool, root: Path, run: Run, out: TextIO) -> None:
        home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        units = home / "systemd/user" if is_user else Path("/etc/systemd/system")
        self._label = PREFIX + name
        self._unit = root / units.relative_to("/") / f"{self._label}.service"
        # Once it has run, the system's manager keeps it below `private`, with a link to it.
        self._state = root / "var/lib" / self._label
        self._is_user = is_user
        self._run = run
        self._out = out

    def install(self, unit: Unit, is_started: bool) -> int:
        """Write the unit and what it needs, and have systemd start it."""
        if not self._is_user:
            self._copy(unit.settings)
        self._unit.parent.mkdir(parents=True, exist_ok=True)
        _written(self._unit, unit.text.encode(), 0o644)
        self._out.write(f"{self._unit}\n")
        if not is_started:
            return DONE
        for words in (("daemon-reload",), ("enable", self._label), ("restart", self._label)):
            if self._tell(*words) != DONE:
                return self._failed()
        if self._is_user:
            self._out.write("It ends when you sign out, unless: loginctl enable-linger\n")
        return DONE

    def do(self, verb: str) -> int:
        """Restart or remove what is installed; raises ``CannotInstall`` where nothing is."""
        if not self._unit.exists():
            raise CannotInstall(f"{self._unit} is not there; `swarm service install SETTINGS` makes it")
        if verb == "restart":
            return DONE if self._tell("restart", self._label) == DONE else self._failed()
        ended = self._tell("disable", "--now", self._label)
        self._unit.unlink()
        self._tell("daemon-reload")
        kept = "" if self._is_user else f"; what it stored stays in {self._state}"
        self._out.write(f"{self._unit} is removed{kept}\n")
        return DONE if ended == DONE else FAILED

    def _copy(self, path: str) -> None:
        """Put the settings into the service's folder, and once the files that they name in their own folder."""
        settings, folder = Settings.load(path), Path(path).parent
        self._state.mkdir(mode=0o700, parents=True, exist_ok=True)
        named = [settings.node.store, settings.node.membership]
        for file in [Path(each) for each in named if each and each != IN_MEMORY]:
            try:
                inside = file.relative_to(folder)
            except ValueError:
                raise CannotInstall(
                    f"{file} lies outside of {folder}, where the service could not write; name it without a folder"
                ) from None
            for each in (file, *(file.with_name(file.name + ending) for ending in ("-wal", "-shm"))):
                target = self._state / inside.with_name(each.name)
                if each.exists() and not target.exists():
                    target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                    shutil.copyfile(each, target)
                    target.chmod(0o600)
        _written(self._state / SETTINGS, Path(path).read_bytes(), 0o600)
        self._own()

    def _own(self) -> None:
        """Give the files to whoever has the folder already: systemd hands on the whole only when it makes the user."""
        owner = self._state.stat()
        for file in self._state.rglob("*"):
            if os.getuid() == 0:
                os.chown(file, owner.st_uid, owner.st_gid, follow_symlinks=False)

    def _tell(self, *words: str) -> int:
        return self._run(["systemctl", *(["--user"] if self._is_user else []), *words])

    def _failed(self) -> int:
        user = "--user " if self._is_user else ""
        sys.stderr.write(f"swarm service: systemd refused; see: journalctl {user}-u {self._label} -n 30\n")
        return FAILED


def _written(path: Path, data: bytes, mode: int) -> None:
    """Write a file whole or not at all."""
    new = path.with_name(path.name + ".new")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
    new.chmod(mode)
    new.replace(path)
