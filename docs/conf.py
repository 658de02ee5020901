"""Sphinx's settings. The site is built by ``docs/make.py``.

Its source folder is the whole checkout, so that links between pages of ``docs`` and of ``examples``
are the same for Sphinx as for GitHub.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

from neuros import __version__  # noqa: E402

project = "NeuROS"
copyright = "the authors of NeuROS"
version = release = __version__
language = "en-GB"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "site_parts",
]
root_doc = "docs/index"
include_patterns = [
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "docs/*.md",
    "extensions/*/README.md",
    "docs/reference/**.md",
    "examples/**README.md",
    "workspace/README.md",
]
exclude_patterns = [".*", "docs/build", "runs", "build"]

myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid"]
# Attributes of several classes are named `type` or `depth`, as builtins and arguments are.
suppress_warnings = ["ref.python"]

autodoc_default_options = {"members": True, "undoc-members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True  # else the paths of this machine are shown
autodoc_typehints_format = "short"
autodoc_use_type_comments = False  # there are none, and looking for them takes half a minute
napoleon_use_ivar = True
# The theme makes the whole navigation anew for each of 400 pages; with every function in it, that
# took four minutes.
toc_object_entries = False
# What an installation without further extras has not; no page says anything about these.
autodoc_mock_imports = [
    "launch",
    "debugpy",
    "hypothesis",
    "mujoco",
    "nest",
    "pandas",
    "pytest",
    "rerun",
    "foxglove",
    "trimesh",
]

viewcode_follow_imported_members = False

nitpicky = True
# Types of other projects are not linked, since no network is needed, nor private ones.
nitpick_ignore_regex = [
    ("py:.*", r"(?!neuros\.).*"),
    ("py:(class|obj)", r".*\._\w+"),
    ("py:(class|obj)", r"neuros\.registry\.Part"),  # a type variable
]

smartquotes = False  # options begin with two hyphens

html_theme = "furo"
html_title = "NeuROS"
html_static_path = ["_static"]
html_css_files = ["site.css"]
templates_path = ["_templates"]
html_additional_pages = {"index": "to_front_page.html"}
html_copy_source = False
html_show_sphinx = False
copybutton_prompt_text = r"\$ "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True
