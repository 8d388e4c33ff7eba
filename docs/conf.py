"""How Sphinx builds the documentation: `sphinx-build -W -b html docs OUT`.

The notebooks lie in `notebooks/`, without outputs.  They are copied to `docs/notebooks/`, which git
ignores, and executed there; where the variable FACTORED_POLCA_NOTEBOOKS names a folder of copies that
have been executed already, those are taken as they are.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_extensions"))

from pygments.lexers import get_all_lexers  # noqa: E402
from pygments.lexers.special import TextLexer  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402

import factored_polca  # noqa: E402

project = "factored_polca"
author = copyright = "The factored_polca authors"
release = version = factored_polca.__version__
language = "en"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "command_help",
    "drawn",
    "further_names",
    "mathml",
]
exclude_patterns = ["out", "_build", "notebooks/README.md"]

# A folder of pages may be empty, as `notebooks/` in a copy of the sources without them.
logging.getLogger("sphinx.sphinx.directives.other").addFilter(
    lambda record: "didn't match any documents" not in record.getMessage()
)

# Markdown: $math$, tables of definitions, `:::` fences, links to headings.
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 3
html_math_renderer = "mathml"  # formulas need neither a network nor a script

# In docstrings one backtick is code.
default_role = "code"
highlight_language = "none"

# The reference, from docstrings.
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_rtype = False

copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"factored_polca {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_sphinx = False


def copy_notebooks() -> bool:
    """Bring the notebooks under the pages; answer whether they have been executed already."""
    executed = os.environ.get("FACTORED_POLCA_NOTEBOOKS")
    source = Path(executed) if executed else HERE.parent / "notebooks"
    target = HERE / "notebooks"
    target.mkdir(exist_ok=True)
    names = {path.name for path in source.glob("[0-9]*.ipynb")}
    if executed and not names:
        raise FileNotFoundError(f"FACTORED_POLCA_NOTEBOOKS={executed} holds no notebooks")
    for path in target.glob("*.ipynb"):
        if path.name not in names:
            path.unlink()
    for name in names:
        new = (source / name).read_bytes()
        if not (target / name).is_file() or (target / name).read_bytes() != new:
            shutil.copyfile(source / name, target / name)
    return bool(executed)


nb_execution_mode = "off" if copy_notebooks() else "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True


def setup(app: Sphinx) -> None:
    """Show fences of kinds that no lexer knows, and commands with what they print, as plain text."""
    pages = [path for path in HERE.rglob("*.md") if "out" not in path.parts]
    kinds = {
        kind
        for path in pages
        for kind in re.findall(r"^```([a-z]\w*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    known = {name for _, names, _, _ in get_all_lexers() for name in names}
    for kind in sorted({"console", "output"} | kinds - known):
        app.add_lexer(kind, TextLexer)
