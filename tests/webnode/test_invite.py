"""Tests of ``webnode.invite``: the addresses of the page for guests, and their QR code."""

from __future__ import annotations

import re
import sys
from importlib.util import find_spec
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from webnode.invite import MARGIN, Invites, make_qr_code, sort_by_reach

LINK = "https://192.168.0.7:8443/#code=AQUAagJ8oCVYkDIF5Q4LZ3Vlc3TsjPp7rFj9hsoSg2xWYr0E/phone"


class InviteTests(SynchronousTestCase):
    def test_offer_the_best_first(self) -> None:
        """Pages in the network come before pages on this machine, and pages over TLS before pages over HTTP."""
        here, plain, name = "https://127.0.0.1:8443", "http://192.168.0.7:8080", "https://vaio.local:8443"
        self.assertEqual(sort_by_reach([here, plain, name, plain]), [name, plain, here])
        anything: Any = None
        self.assertEqual(Invites(lambda: [here, plain], b"", "", anything, anything).urls(), [plain, here])

    def test_draw_what_a_camera_reads(self) -> None:
        """A decoder reads the link in the QR code, which has a margin and no style attribute."""
        import cv2
        import numpy as np

        drawing = make_qr_code(LINK)
        self.assertNotIn("style", drawing)
        (size,) = re.findall(r'viewBox="0 0 (\d+) \1"', drawing)
        picture = np.full((int(size), int(size)), 255, np.uint8)
        x = y = 0.0
        for verb, step, fall in re.findall(r"([Mmh])(-?[\d.]+)(?: (-?[\d.]+))?", drawing.split(' d="')[1]):
            if verb == "h":
                picture[int(y), int(x) : int(x + float(step))] = 0
                x += float(step)
            else:
                x, y = (float(step), float(fall)) if verb == "M" else (x + float(step), y + float(fall))
        self.assertTrue((picture[:MARGIN] == 255).all())
        large = np.kron(picture, np.ones((8, 8), np.uint8))
        self.assertEqual(cv2.QRCodeDetector().detectAndDecode(large)[0], LINK)

    if missing := [name for name in ("cv2", "segno") if find_spec(name) is None]:
        test_draw_what_a_camera_reads.skip = f"THE QR CODE IS NOT TESTED: missing {missing}"  # type: ignore[attr-defined]

    def test_draw_nothing_where_it_cannot(self) -> None:
        """For an empty link, or without the library, no QR code is drawn."""
        self.assertEqual(make_qr_code(""), "")
        self.addCleanup(sys.modules.update, {"segno": sys.modules["segno"]} if "segno" in sys.modules else {})
        self.addCleanup(sys.modules.pop, "segno", None)
        sys.modules["segno"] = None  # type: ignore[assignment]
        self.assertEqual(make_qr_code(LINK), "")
