"""Sphinx makes the documentation site: `sphinx-build -W docs build/site`.

The pages are Markdown that reads in the repository, too; the reference comes from the docstrings.
Formulas become MathML, which browsers show without a script: the site asks no server for anything.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, GoogleDocstring

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # the reference is of this checkout, whatever is installed

from diffpoisson.mesh import Mesh  # noqa: E402  (found by the line above)
from diffpoisson.transforms import constant_property  # noqa: E402

project = "diffpoisson"
author = copyright = "The diffpoisson authors"  # noqa: A001 (Sphinx's name)
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = "diffpoisson"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False

# `sphinx-build -b linkcheck docs build/links`, by hand before a release: it asks the network.
linkcheck_ignore = [r"http://(127\.0\.0\.1|localhost)(:\d+)?"]  # the windows of `njf view`
linkcheck_allowed_redirects = {r"https://doi\.org/.*": r".*"}  # what a DOI is for
linkcheck_timeout = 30
linkcheck_retries = 2

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
default_role = "py:obj"  # `jacobians` is a link where such a thing is documented, else code
python_maximum_signature_line_length = 88

GOOGLE_STYLE = Config(napoleon_custom_sections=[("Attributes", "params_style")])

# Files at the repository's root that are pages here.
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}


def move_links(app: Sphinx, path: Path, parent: str, content: list[str]) -> None:
    """Links of a file at the repository's root, where it is included."""

    def moved(link: re.Match[str]) -> str:
        target = link[1]
        if target.startswith("docs/"):
            return f"]({target.removeprefix('docs/')})"
        return f"]({PAGES.get(target, f'../{target}')})"

    content[0] = re.sub(r"\]\((?!\w+:|#)([^)\s]+)\)", moved, content[0])


def read_docstring(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Google's sections to fields. |tⱼ| is an area, no substitution, but in code stays as it is."""
    # As a method: of a property, napoleon would take what precedes a colon for its type.
    what = "method" if what in ("attribute", "property") else what
    fields = GoogleDocstring(lines, GOOGLE_STYLE, app, what, name, obj, options).lines()
    for i, line in enumerate(fields):
        parts = line.split("`")
        parts[::2] = [part.replace("|", r"\|") for part in parts[::2]]
        fields[i] = "`".join(parts)
    lines[:] = fields


def skip_fields(app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool:
    """Fields of named tuples are documented with their class, under Attributes."""
    return skip or type(obj).__name__ == "_tuplegetter"


def show_as_properties(owner: type) -> None:
    """Let autodoc see what is computed once as properties, with their types."""
    for name, member in list(vars(owner).items()):
        if isinstance(member, constant_property):
            setattr(owner, name, property(member.func))


def visit_inline_math(translator: Any, node: nodes.math) -> None:
    """A formula within a line."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def visit_block_math(translator: Any, node: nodes.math_block) -> None:
    """A formula on a line of its own."""
    formula = convert(node.astext(), display="block")
    translator.body.append(f'<div class="formula">{formula}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register what is above."""
    show_as_properties(Mesh)
    app.connect("include-read", move_links)
    app.connect("autodoc-process-docstring", read_docstring)
    app.connect("autodoc-skip-member", skip_fields)
    app.add_html_math_renderer("mathml", (visit_inline_math, None), (visit_block_math, None))
