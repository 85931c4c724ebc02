"""Attack S23: another user of the same computer: control sockets in a shared folder, secrets on command lines."""

from __future__ import annotations

import io
import json
import os
import shutil
import socket
import struct
import sys
import tempfile
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.command import asked, check_peer
from middleware.entangled.control.place import NoControl, check_socket, folder, found, made
from swarmnode.invitation import invitations
from swarmnode.plugin import Options

SECRET = "the secret of a classroom"


class ControlSocketTests(SynchronousTestCase):
    """Another user created the folder or the socket before the node."""

    def setUp(self) -> None:
        # The path of a socket has a maximum length, which trial's folders exceed.
        self.runtime = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.runtime)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(self.runtime)})
        self.me = os.getuid()

    def be_another(self) -> None:
        """Continue as another user, which owns none of the existing files."""
        self.patch(os, "getuid", lambda: self.me + 1)

    def listening(self, name: str) -> Path:
        path = folder() / f"{name}.control"
        server = socket.socket(socket.AF_UNIX)
        self.addCleanup(server.close)
        server.bind(str(path))
        server.listen()
        return path

    def test_folder_of_another(self) -> None:
        """A folder of another user is neither read nor used for a socket."""
        made("vaio").touch()
        self.assertEqual(found("vaio").name, "vaio.control")
        self.be_another()
        for use in (found, made):
            self.assertIn("accessible to other users", str(self.assertRaises(NoControl, use, "vaio")))

    def test_page_of_another(self) -> None:
        """A page in another user's note is not opened."""
        note = {"name": "vaio", "url": "http://127.0.0.1:1/", "code": "loud-otter", "pid": os.getpid()}
        made("vaio").with_suffix(".page").write_text(json.dumps(note))
        self.assertEqual([each.name for each in invitations()], ["vaio"])
        self.be_another()
        self.assertRaises(NoControl, invitations)

    def test_folder_that_others_write(self) -> None:
        """A folder that other users can write is refused."""
        made("vaio").touch()
        folder().chmod(0o777)
        for use in (found, made):
            self.assertRaises(NoControl, use, "vaio")

    def test_folder_that_is_a_link(self) -> None:
        """A symbolic link is refused as the folder, even if its target is valid."""
        other = self.runtime / "elsewhere"
        other.mkdir(mode=0o700)
        (other / "vaio.control").touch()
        folder().symlink_to(other)
        for use in (found, made):
            self.assertRaises(NoControl, use, "vaio")

    def test_socket_of_another(self) -> None:
        """A socket of another user, and a file that is not a socket, get no request."""
        made("vaio")
        path = self.listening("vaio")
        file = folder() / "file.control"
        file.touch()
        link = folder() / "link.control"
        link.symlink_to(path)
        for each in (file, link):
            self.assertIn("is no socket", str(self.assertRaises(NoControl, list, asked(each, {}))))
        self.be_another()
        self.assertIn("accessible to other users", str(self.assertRaises(NoControl, list, asked(path, {}))))

    def test_service_of_another_user(self) -> None:
        """Root may contact another user's service in a named folder, but not in the shared folder."""
        made("vaio")
        path = self.listening("vaio")
        for each in (folder(), path):
            if self.me == 0:
                os.chown(each, 12345, 12345)
        self.patch(os, "getuid", lambda: 0)
        self.assertEqual(found("vaio"), path)
        check_socket(path)
        self.assertRaises(NoControl, made, "vaio")
        del os.environ["XDG_RUNTIME_DIR"]
        self.assertRaises(NoControl, check_socket, path)

    def test_process_of_another(self) -> None:
        """A socket with another user's process behind it is refused."""
        here, there = socket.socketpair(socket.AF_UNIX)
        self.addCleanup(here.close)
        self.addCleanup(there.close)
        path = made("vaio")
        check_peer(here, path)

        class Connection:
            """A connection to a process of the user ``user``."""

            def __init__(self, user: int) -> None:
                self.user = user

            def getsockopt(self, level: int, option: int, size: int) -> bytes:
                return struct.pack("3i", 1, self.user, 1)

        check_peer(Connection(0), path)  # type: ignore[arg-type]
        error = self.assertRaises(NoControl, check_peer, Connection(self.me + 1), path)
        self.assertIn("another user", str(error))


class TeamKeyTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.path = Path(self.mktemp())
        self.path.touch(mode=0o600)
        self.path.write_text(f"{SECRET}\n", encoding="utf-8")

    def options(self, *words: str) -> Options:
        options = Options()
        options.parseOptions(["--name", "a", *words])
        return options

    def refusal(self, *words: str) -> str:
        """Return the error of a refused command line."""
        said = io.StringIO()
        self.patch(sys, "stderr", said)
        self.assertEqual(self.assertRaises(SystemExit, self.options, *words).code, 2)
        return said.getvalue()

    def test_not_on_the_command_line(self) -> None:
        """A secret on the command line is refused with the remedy, and the error does not repeat it."""
        said = self.refusal("--team-key", SECRET)
        self.assertIn("--team-key-file", said)
        self.assertNotIn(SECRET, said)

    def test_from_a_file_of_the_owner(self) -> None:
        """The secret is read from a file or standard input; a file that other users can read is refused."""
        self.assertEqual(self.options("--team-key-file", str(self.path)).settings.node.team_key, SECRET)
        self.patch(sys, "stdin", io.TextIOWrapper(io.BytesIO(SECRET.encode())))
        self.assertEqual(self.options("--team-key-file", "-").settings.node.team_key, SECRET)
        self.path.chmod(0o644)
        self.assertIn("chmod 600", self.refusal("--team-key-file", str(self.path)))
        self.path.chmod(0o600)
        self.path.write_bytes(b"\xff")
        self.assertIn("is not text", self.refusal("--team-key-file", str(self.path)))
