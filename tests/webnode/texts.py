"""Load the catalogues of the page's texts."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOM = Path(__file__).parents[2] / "webnode"


def catalogue(language: str) -> dict[str, Any]:
    """Return the texts of a language by key; a text with plural forms is a mapping."""
    source = (ROOM / "static" / "texts" / f"{language}.js").read_text()
    found = re.fullmatch(r"export default (\{.*\});\n", source, re.DOTALL)
    assert found is not None, f"texts/{language}.js is not a single JSON object"
    pairs: list[tuple[str, Any]] = json.loads(found[1], object_pairs_hook=list)
    keys = [key for key, _ in pairs]
    assert keys == sorted(set(keys)), f"the keys of texts/{language}.js are not sorted, or a key occurs twice"
    return {key: dict(text) if isinstance(text, list) else text for key, text in pairs}
