"""Tests of ``swarmnode.page_access`` and ``swarm web``: the address of the page and its access code."""

from __future__ import annotations

import io
import json
import os
import stat
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from swarmnode.page_access import PageAccess, announce_page, find_terminal, list_pages, make_url
from swarmnode.web_code import main

OWN = PageAccess("vaio", "http://127.0.0.1:8080/", "quiet-otter", os.getpid())


class PageAccessTests(SynchronousTestCase):
    def setUp(self) -> None:
        # The note is written to the folder of the control sockets, which this variable moves into the test folder.
        self.where = Path(self.mktemp())
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": str(self.where)})

    def test_leave_a_note(self) -> None:
        """A web node writes its address and code to a private file, which the next start replaces."""
        self.patch(sys.modules["middleware.entangled.control.socket_path"], "MAX_PATH_BYTES", 4096)
        for code in ("quiet-otter", "loud-otter"):
            announce_page("vaio", "0.0.0.0", lambda: 8080, code)
        self.assertEqual(list_pages(), [PageAccess("vaio", "http://127.0.0.1:8080/", "loud-otter", os.getpid())])
        announce_page("vaio", "0.0.0.0", lambda: 8080, "quiet-otter", 8443)
        self.assertEqual(list_pages()[0].secure, "https://127.0.0.1:8443/")
        (note,) = (self.where / "swarm-node").iterdir()
        self.assertEqual(stat.S_IMODE(note.stat().st_mode), 0o600)

    def test_show_the_code_at_a_terminal(self) -> None:
        """A node that is started at a terminal prints the code; to other or closed streams it prints no code."""
        self.patch(sys.modules["middleware.entangled.control.socket_path"], "MAX_PATH_BYTES", 4096)
        screen = io.StringIO()
        announce_page("vaio", "0.0.0.0", lambda: 8080, "quiet-otter", terminal=screen)
        self.assertIn("http://127.0.0.1:8080/#code=quiet-otter", screen.getvalue())
        announce_page("vaio", "0.0.0.0", lambda: 8080, "", terminal=(silent := io.StringIO()))
        self.assertEqual(silent.getvalue(), "")
        closed = io.StringIO()
        closed.close()
        for stream in (None, io.StringIO(), closed):
            self.patch(sys, "__stderr__", stream)
            self.assertIsNone(find_terminal())

    def test_pass_over_what_is_no_note(self) -> None:
        """The note of a node that has ended is ignored, and so are invalid notes."""
        (self.where / "swarm-node").mkdir(mode=0o700, parents=True)
        for name, words in (
            ("a", "{}"),
            ("b", "no JSON"),
            ("c", '{"name": "c", "url": "", "code": "", "pid": 4194305}'),
        ):
            (self.where / "swarm-node" / f"{name}.page").write_text(words)
        self.assertEqual(list_pages(), [])

    def test_name_an_address_for_this_machine(self) -> None:
        """A wildcard address is replaced by an address that a browser on this machine can open."""
        self.assertEqual(make_url("0.0.0.0", 80), "http://127.0.0.1:80/")
        self.assertEqual(make_url("::", 80), "http://[::1]:80/")
        self.assertEqual(make_url("192.168.0.2", 8080), "http://192.168.0.2:8080/")


class WebCodeTests(SynchronousTestCase):
    def asked(self, *words: str, here: list[PageAccess] | None = None) -> tuple[int, str, str]:
        out, errors = io.StringIO(), io.StringIO()
        self.patch(sys, "stderr", errors)
        code = main(words, out, lambda: [OWN] if here is None else here)
        return code, out.getvalue(), errors.getvalue()

    def test_tell_the_code(self) -> None:
        """The code and a link that contains the code are printed, also as JSON.

        If sign-in is off, the output says so.
        """
        code, out, _ = self.asked()
        self.assertEqual(code, 0)
        self.assertIn("vaio: http://127.0.0.1:8080/  code quiet-otter, or open", out)
        self.assertIn("http://127.0.0.1:8080/#code=quiet-otter", out)
        self.assertEqual(json.loads(self.asked("--json")[1])["code"], "quiet-otter")
        secure = PageAccess("a", "http://127.0.0.1:1/", "quiet-otter", 1, "https://127.0.0.1:2/")
        self.assertIn("a: http://127.0.0.1:1/ and https://127.0.0.1:2/  code", self.asked(here=[secure])[1])
        self.assertIn("no sign-in", self.asked(here=[PageAccess("a", "http://127.0.0.1:1/", "", 1)])[1])

    def test_tell_that_there_is_none(self) -> None:
        """If no page or no such node is running, one line lists the nodes that have a page, and the exit code is 2."""
        code, out, errors = self.asked("--node", "dog1")
        self.assertEqual((code, out), (2, ""))
        self.assertIn("no node 'dog1' with a page runs on this machine; nodes with a page: vaio", errors)
        self.assertIn("start a node with the role", self.asked(here=[])[2])
