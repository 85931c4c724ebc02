"""Tests of ``sim.robots.camera``."""

from __future__ import annotations

import math
from random import Random

import cv2
import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from sim.robots.camera import Camera
from sim.robots.rendering import FOCAL_X_PIXELS, HEIGHT, WIDTH, Image
from sim.robots.scene import load_scene
from sim.robots.sensor import NOSE_M
from sim.robots.world import World


def red(image: Image) -> Image:
    """Return the mask of the target's red: one range of Cr, as in the colour space of the ERS-7."""
    mask = cv2.inRange(cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb), (20, 170, 60), (235, 255, 128))
    return np.asarray(mask, dtype=np.uint8)


def columns(mask: Image) -> tuple[int, int]:
    """Return the first and the last column of a mask."""
    lit = np.nonzero(mask.any(axis=0))[0]
    return int(lit[0]), int(lit[-1])


class CameraTests(SynchronousTestCase):
    """dog1 stands at the left and looks to the right."""

    def setUp(self) -> None:
        """Place the other dogs behind dog1."""
        self.world = World(Random(1), load_scene("three-dogs"))
        self.world.move_dog("dog1", 0.5, 1.2, 0.0)
        self.world.move_dog("dog2", 0.3, 0.3, 0.0)
        self.world.move_dog("dog3", 0.3, 2.1, 0.0)
        self.camera = Camera(Random(2), self.world)
        self.dog = self.world.dogs["dog1"]

    def mask(self) -> Image:
        """Return the red mask of a new picture."""
        return red(self.camera.render_image(self.dog))

    def test_sees_no_red_without_a_target(self) -> None:
        """Walls, floor, dogs and noise contain no target red, even at close range, in corners and at walls."""
        for seed in range(20):
            self.world.scatter(seed, clearance=0.25, from_walls=0.12)
            for dog in self.world.dogs.values():
                image = self.camera.render_image(dog)
                self.assertEqual((image.shape, image.dtype), ((HEIGHT, WIDTH, 3), np.uint8))
                self.assertGreater(float(image.std()), 1.0)
                self.assertEqual(int(red(image).sum()), 0)
            self.world.move_dog("dog1", 0.12, 0.12, Random(seed).uniform(-3.0, 3.0))
            self.camera.render_image(self.dog)

    def test_shows_the_target_where_and_as_large_as_it_is(self) -> None:
        """Bearing and width of the red area match the geometry within 1.6 pixels, both close and far away."""
        for x, y in ((1.0, 1.2), (1.5, 1.35), (2.0, 0.9), (2.8, 1.2), (2.8, 1.9)):
            self.world.place_target(x, y)
            left, right = columns(self.mask())
            ahead, aside = x - 0.5 - NOSE_M, y - 1.2
            bearing = math.atan2(aside, ahead)
            half = math.asin(0.08 / math.hypot(ahead, aside))
            self.assertLess(abs(left - (WIDTH / 2 - FOCAL_X_PIXELS * math.tan(bearing + half))), 1.6)
            self.assertLess(abs(right + 1 - (WIDTH / 2 - FOCAL_X_PIXELS * math.tan(bearing - half))), 1.6)

    def test_sees_the_target_across_the_yard(self) -> None:
        """At the far end of the map, and after JPEG compression, the target is at least nine pixels wide."""
        self.world.move_dog("dog1", 0.14, 1.2, 0.0)
        self.world.place_target(2.9, 1.2)
        picture = cv2.imdecode(np.frombuffer(self.camera.render_jpeg(self.dog), np.uint8), cv2.IMREAD_COLOR)
        left, right = columns(red(np.asarray(picture, dtype=np.uint8)))
        self.assertGreaterEqual(right - left + 1, 9)

    def test_fills_the_view_when_touching(self) -> None:
        """In a camera that touches the target, more than 70 % of the picture is red."""
        self.world.place_target(0.5 + 0.12 + 0.081, 1.2)
        self.assertGreater(int((self.mask() > 0).sum()), 0.7 * WIDTH * HEIGHT)

    def test_hides_the_target_behind_a_dog(self) -> None:
        """A dog between camera and target hides the target at any heading.

        A dog next to the target or behind the target does not.
        """
        self.world.place_target(2.4, 1.2)
        plain = int((self.mask() > 0).sum())
        self.assertGreater(plain, 100)
        for heading in (0.0, math.pi / 2, math.pi, -math.pi / 2, 0.7):
            self.world.move_dog("dog2", 1.2, 1.2, heading)
            self.assertEqual(int((self.mask() > 0).sum()), 0, heading)
        self.world.move_dog("dog2", 1.2, 1.6, 0.0)
        self.assertGreater(int((self.mask() > 0).sum()), 0.9 * plain)
        self.world.place_target(1.4, 1.2)
        plain = int((self.mask() > 0).sum())
        self.world.move_dog("dog2", 2.0, 1.2, 0.0)
        self.assertLess(abs(int((self.mask() > 0).sum()) - plain), 0.05 * plain)

    def test_shows_as_many_stripes_as_the_dog_has(self) -> None:
        """One, two or three yellow stripes are visible on the back of the head of a dog in front."""
        self.camera = Camera(Random(2), self.world)
        for name, stripes in (("dog2", 2), ("dog3", 3)):
            self.world.move_dog(name, 1.1, 1.2, 0.0)
            picture = self.camera.render_image(self.dog)
            blue, green, ruby = (picture[:, :, i].astype(int) for i in range(3))
            yellow = (ruby > 150) & (green > 120) & (blue < 110)
            row = yellow[yellow.sum(axis=1).argmax()]
            self.assertEqual(int((np.diff(row.astype(int)) == 1).sum()) + int(row[0]), stripes, name)
            self.world.move_dog(name, 0.3, 0.3 if name == "dog2" else 2.1, 0.0)
