"""Code: what operators sign in with where the settings name none; needs no library."""

from __future__ import annotations

import random

LETTERS = "abcdefghjkmnpqrstuvwxyz"
"""None looks like another, or like a digit."""


def draw_code(rng: random.Random) -> str:
    """A code to sign in with."""
    letters = "".join(rng.choice(LETTERS) for _ in range(8))
    return f"{letters[:4]}-{letters[4:]}"
