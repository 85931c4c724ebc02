"""Attack S23: attack as another user of the same computer, by control sockets and secrets on command lines."""

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
    """Another user created the folder or the socket before the node started."""

    def setUp(self) -> None:
        # The path of a socket has a maximum length, and the folders of trial exceed it.
        self.runtime = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.runtime)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(self.runtime)})
        self.me = os.getuid()

    def be_another(self) -> None:
        """Continue as a different user, the owner of none of the existing files."""
        self.patch(os, "getuid", lambda: self.me + 1)

    def listening(self, name: str) -> Path:
        path = find_folder() / f"{name}.control"
        server = socket.socket(socket.AF_UNIX)
        self.addCleanup(server.close)
        server.bind(str(path))
        server.listen()
        return path

    def test_folder_of_another(self) -> None:
        """The folder of another user is neither read nor used for a socket."""
        prepare_path("vaio").touch()
        self.assertEqual(find_socket("vaio").name, "vaio.control")
        self.be_another()
        for use in (find_socket, prepare_path):
            self.assertIn("accessible to other users", str(self.assertRaises(NoControl, use, "vaio")))

    def test_page_of_another(self) -> None:
        """A page address in another user's file is not opened."""
        note = {"name": "vaio", "url": "http://127.0.0.1:1/", "code": "loud-otter", "pid": os.getpid()}
        prepare_path("vaio").with_suffix(".page").write_text(json.dumps(note))
        self.assertEqual([each.name for each in list_pages()], ["vaio"])
        self.be_another()
        self.assertRaises(NoControl, list_pages)

    def test_folder_that_others_write(self) -> None:
        """A folder to which other users can write is rejected."""
        prepare_path("vaio").touch()
        find_folder().chmod(0o777)
        for use in (find_socket, prepare_path):
            self.assertRaises(NoControl, use, "vaio")

    def test_folder_that_is_a_link(self) -> None:
        """A symbolic link instead of the folder is rejected, even if the target of the link is valid."""
        other = self.runtime / "elsewhere"
        other.mkdir(mode=0o700)
        (other / "vaio.control").touch()
        find_folder().symlink_to(other)
        for use in (find_socket, prepare_path):
            self.assertRaises(NoControl, use, "vaio")

    def test_socket_of_another(self) -> None:
        """A socket of another user, or a file that is not a socket, gets no request."""
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
        """Root may connect to a service of another user if root names its folder, but not in the shared folder."""
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
        """A socket is rejected if the process that listens on it belongs to another user."""
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
        """Return the error message for a rejected command line."""
        said = io.StringIO()
        self.patch(sys, "stderr", said)
        self.assertEqual(self.assertRaises(SystemExit, self.options, *words).code, 2)
        return said.getvalue()

    def test_not_on_the_command_line(self) -> None:
        """A secret on the command line is rejected, and the error states the remedy without repeating the secret."""
        said = self.refusal("--team-key", SECRET)
        self.assertIn("--team-key-file", said)
        self.assertNotIn(SECRET, said)

    def test_from_a_file_of_the_owner(self) -> None:
        """The secret is read from a file or from standard input; a file that other users can read is rejected."""
        self.assertEqual(self.options("--team-key-file", str(self.path)).settings.node.team_key, SECRET)
        self.patch(sys, "stdin", io.TextIOWrapper(io.BytesIO(SECRET.encode())))
        self.assertEqual(self.options("--team-key-file", "-").settings.node.team_key, SECRET)
        self.path.chmod(0o644)
        self.assertIn("chmod 600", self.refusal("--team-key-file", str(self.path)))
        self.path.chmod(0o600)
        self.path.write_bytes(b"\xff")
        self.assertIn("is not text", self.refusal("--team-key-file", str(self.path)))
