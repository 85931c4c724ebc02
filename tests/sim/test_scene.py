"""Tests of ``sim.robots.scene``."""

from __future__ import annotations

import json
import math
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from sim.robots.scene import SceneError, list_scenes, load_scene, parse_scene


class SceneTests(SynchronousTestCase):
    """Scenes are read from JSON."""

    def setUp(self) -> None:
        """Create a valid scene, which the tests change."""
        self.fields = {
            "name": "two",
            "width": 2.0,
            "height": 2.0,
            "wall_height": 0.3,
            "target": {"radius": 0.08, "height": 0.22},
            "dogs": [
                {"name": "a", "x": 0.5, "y": 0.5, "heading_deg": 90, "stripes": 1},
                {"name": "b", "x": 1.5, "y": 1.5, "heading_deg": 0, "stripes": 2},
            ],
        }

    def refusal(self) -> str:
        """Return the error message for the changed scene."""
        return str(self.assertRaises(SceneError, parse_scene, json.dumps(self.fields), "two.json"))

    def test_loads_the_three_dogs_of_the_thesis(self) -> None:
        """The installed scene has dogs with one, two and three stripes in a walled enclosure, as in the thesis."""
        self.assertIn("three-dogs", list_scenes())
        scene = load_scene("three-dogs")
        self.assertEqual([(one.name, one.stripes) for one in scene.dogs], [("dog1", 1), ("dog2", 2), ("dog3", 3)])
        self.assertEqual((scene.width, scene.height), (3.0, 2.4))

    def test_reads_a_file(self) -> None:
        """A name that ends in .json is a path, and angles are in degrees; unknown names and paths are rejected."""
        path = Path(self.mktemp() + ".json")
        path.write_text(json.dumps(self.fields))
        self.assertEqual(load_scene(str(path)).dogs[0].heading, math.pi / 2)
        self.assertIn("known are three-dogs", str(self.assertRaises(SceneError, load_scene, "four-cats")))
        self.assertIn("nowhere.json", str(self.assertRaises(SceneError, load_scene, "nowhere.json")))

    def test_refuses_what_is_no_scene(self) -> None:
        """The error for text that is not a JSON object contains the name of the text's source."""
        for text in ("", "{", "[]", "7", "null", "[" * 100_000):
            self.assertIn("two.json", str(self.assertRaises(SceneError, parse_scene, text, "two.json")))

    def test_names_the_wrong_key(self) -> None:
        """The error for a missing or invalid field contains the key of the field.

        Dogs that are in a wall, overlap or have equal names are rejected with a description of the problem.
        """
        wrong = {"width": 0, "height": "2", "wall_height": None, "name": 7, "dogs": [], "target": 3}
        for key, value in wrong.items():
            self.setUp()
            self.fields[key] = value
            self.assertIn(key, self.refusal())
        for key, value, words in (("x", 1.95, "x must be"), ("name", "a", "two dogs"), ("stripes", 9, "stripes")):
            self.setUp()
            self.fields["dogs"][1][key] = value  # type: ignore[index]
            self.assertIn(words, self.refusal())
        self.setUp()
        self.fields["dogs"][1].update(x=0.6, y=0.6)  # type: ignore[index]
        self.assertIn("overlap", self.refusal())
