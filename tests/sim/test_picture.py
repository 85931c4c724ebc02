"""Tests of ``sim.robots.picture``."""

from __future__ import annotations

from random import Random
from typing import Any

import cv2
import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from sim.robots.picture import HEIGHT, WIDTH, draw_map
from sim.robots.scene import load_scene
from sim.robots.world import World


class PictureTests(SynchronousTestCase):
    """The map as seen from above."""

    def setUp(self) -> None:
        """Place a target at the right, above the middle of the map."""
        self.world = World(Random(1), load_scene("three-dogs"))
        self.world.place_target(2.2, 1.7)

    def drawn(self, caption: str = "", **changes: object) -> Any:
        """Draw a snapshot with ``changes``; return the blue, green and red channels of the picture."""
        data = draw_map({**self.world.snapshot(), **changes}, caption)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        self.assertEqual(image.shape, (HEIGHT, WIDTH, 3))
        return np.moveaxis(image.astype(int), 2, 0)

    def test_shows_the_target_where_it_is(self) -> None:
        """The target is drawn red at its position, and nothing is red without a target; a caption is drawn below."""
        blue, green, red = self.drawn()
        rows, lit = np.nonzero((red > 180) & (green < 70) & (blue < 70))
        self.assertGreater(len(rows), 100)
        self.assertTrue(380 < lit.mean() < 500 and 120 < rows.mean() < 220, (lit.mean(), rows.mean()))
        blue, green, red = self.drawn("All robots have found the red target" * 3, target=None)
        self.assertFalse(((red > 180) & (green < 70) & (blue < 70)).any())
        self.assertGreater(int((red[490:] < 120).sum()), 60)

    def test_shows_more_yellow_for_more_stripes(self) -> None:
        """The dog with three stripes is drawn with more than twice the yellow of the dog with one stripe."""
        dogs: Any = self.world.snapshot()["dogs"]
        shown = [self.drawn(dogs=[dog]) for dog in dogs]
        yellow = [int(((red > 200) & (green > 150) & (blue < 100)).sum()) for blue, green, red in shown]
        self.assertGreater(yellow[2], 2.2 * yellow[0])
        self.assertGreater(yellow[0], 5)
