"""Tests of ``sim.robots.picture``."""

from __future__ import annotations

from random import Random

import cv2
import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from sim.robots.picture import overhead, overhead_image
from sim.robots.scene import loaded
from sim.robots.world import World


class PictureTests(SynchronousTestCase):
    """The yard from above."""

    def setUp(self) -> None:
        """The yard with a target."""
        self.world = World(Random(1), loaded("three-dogs"))
        self.world.place_target(2.2, 1.7)

    def test_is_a_png_of_the_size_asked_for(self) -> None:
        """The bytes are a PNG of width by height, whatever the shape."""
        for width, height in ((640, 520), (320, 400)):
            data = overhead(self.world.snapshot(), width, height, {"dog1": [(0.5, 0.5), (1.0, 1.0)]}, "Figure")
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            self.assertEqual(image.shape, (height, width, 3))

    def test_shows_the_target_where_it_is(self) -> None:
        """Red is drawn in the right upper part of the yard for a target there, and nowhere without one."""
        image = overhead_image(self.world.snapshot()).astype(int)
        is_red = (image[:, :, 2] > 180) & (image[:, :, 1] < 70) & (image[:, :, 0] < 70)
        rows, lit = np.nonzero(is_red)
        self.assertGreater(len(rows), 100)
        self.assertTrue(380 < lit.mean() < 500 and 120 < rows.mean() < 220, (lit.mean(), rows.mean()))
        self.world.clear_target()
        image = overhead_image(self.world.snapshot()).astype(int)
        self.assertFalse(((image[:, :, 2] > 180) & (image[:, :, 1] < 70) & (image[:, :, 0] < 70)).any())

    def test_shows_more_yellow_for_more_stripes(self) -> None:
        """The dog with three stripes carries about three times the yellow of the dog with one."""

        def yellow(name: str) -> int:
            snapshot = dict(self.world.snapshot())
            snapshot["dogs"] = [dog for dog in snapshot["dogs"] if dog["name"] == name]  # type: ignore[attr-defined]
            image = overhead_image(snapshot).astype(int)
            return int(((image[:, :, 2] > 200) & (image[:, :, 1] > 150) & (image[:, :, 0] < 100)).sum())

        self.assertGreater(yellow("dog3"), 2.2 * yellow("dog1"))
        self.assertGreater(yellow("dog1"), 5)

    def test_changes_with_trail_and_caption(self) -> None:
        """Trail and caption each leave ink."""
        plain = overhead_image(self.world.snapshot())
        trail = overhead_image(self.world.snapshot(), trails={"dog2": [(1.0, 1.0), (2.0, 1.0)]})
        self.assertGreater(int((plain != trail).sum()), 500)
        caption = overhead_image(self.world.snapshot(), caption="All robots have found the red target" * 3)
        self.assertGreater(int((caption[490:] < 120).sum()), 200)
