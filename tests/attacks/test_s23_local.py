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

from middleware.entangled.control.command import check_peer, send_request
from middleware.entangled.control.socket_path import NoControl, check_socket, find_folder, find_socket, prepare_path
from swarmnode.page_access import list_pages
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
        path = find_folder() / f"{name}.control"
        server = socket.socket(socket.AF_UNIX)
        self.addCleanup(server.close)
        server.bind(str(path))
        server.listen()
        return path

    def test_folder_of_another(self) -> None:
        """A folder of another user is neither read nor used for a socket."""
        prepare_path("vaio").touch()
        self.assertEqual(find_socket("vaio").name, "vaio.control")
        self.be_another()
        for use in (find_socket, prepare_path):
            self.assertIn("accessible to other users", str(self.assertRaises(NoControl, use, "vaio")))

    def test_page_of_another(self) -> None:
        """A page in another user's note is not opened."""
        note = {"name": "vaio", "url": "http://127.0.0.1:1/", "code": "loud-otter", "pid": os.getpid()}
        prepare_path("vaio").with_suffix(".page").write_text(json.dumps(note))
        self.assertEqual([each.name for each in list_pages()], ["vaio"])
        self.be_another()
        self.assertRaises(NoControl, list_pages)

    def test_folder_that_others_write(self) -> None:
        """A folder that other users can write is refused."""
        prepare_path("vaio").touch()
        find_folder().chmod(0o777)
        for use in (find_socket, prepare_path):
            self.assertRaises(NoControl, use, "vaio")

    def test_folder_that_is_a_link(self) -> None:
        """A symbolic link is refused as the folder, even if its target is valid."""
        other = self.runtime / "elsewhere"
        other.mkdir(mode=0o700)
        (other / "vaio.control").touch()
        find_folder().symlink_to(other)
        for use in (find_socket, prepare_path):
            self.assertRaises(NoControl, use, "vaio")

    def test_socket_of_another(self) -> None:
        """A socket of another user, and a file that is not a socket, get no request."""
        prepare_path("vaio")
        path = self.listening("vaio")
        file = find_folder() / "file.control"
        file.touch()
        link = find_folder() / "link.control"
        link.symlink_to(path)
        for each in (file, link):
            self.assertIn("is not a socket", str(self.assertRaises(NoControl, list, send_request(each, {}))))
        self.be_another()
        self.assertIn("accessible to other users", str(self.assertRaises(NoControl, list, send_request(path, {}))))

    def test_service_of_another_user(self) -> None:
        """Root may contact another user's service in a named folder, but not in the shared folder."""
        prepare_path("vaio")
        path = self.listening("vaio")
        for each in (find_folder(), path):
            if self.me == 0:
                os.chown(each, 12345, 12345)
        self.patch(os, "getuid", lambda: 0)
        self.assertEqual(find_socket("vaio"), path)
        check_socket(path)
        self.assertRaises(NoControl, prepare_path, "vaio")
        del os.environ["XDG_RUNTIME_DIR"]
        self.assertRaises(NoControl, check_socket, path)

    def test_process_of_another(self) -> None:
        """A socket with another user's process behind it is refused."""
        here, there = socket.socketpair(socket.AF_UNIX)
        self.addCleanup(here.close)
        self.addCleanup(there.close)
        path = prepare_path("vaio")
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
