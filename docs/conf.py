"""Configuration of the documentation, built by ``make docs``."""

from __future__ import annotations

import sys
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

from generate import generate  # noqa: E402

generate()

project = "swarm-node"
author = "The swarm-node maintainers"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["scale"]
html_theme = "furo"
html_title = "swarm-node"
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
# Links to files outside of docs/ are for readers of the repository.
suppress_warnings = ["myst.xref_missing"]
autodoc_typehints = "signature"
autodoc_member_order = "bysource"


def setup(app: Sphinx) -> None:
    """Show Mermaid diagrams as text: their renderer would have to be loaded from elsewhere."""
    app.add_lexer("mermaid", TextLexer)
