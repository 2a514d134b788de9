"""Sphinx configuration."""

from __future__ import annotations

from importlib import metadata

project = "cura_torchrl"
author = "cura_torchrl contributors"
copyright = f"2026, {author}"
release = metadata.version("cura-torchrl")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["amsmath", "dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = "cura_torchrl"
html_static_path = ["_static"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_custom_sections = [("Source", "notes_style")]
