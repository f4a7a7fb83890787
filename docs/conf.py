"""How the documentation is built: `make docs`."""

import os
import runpy
import sys
from importlib.util import find_spec
from pathlib import Path

import jupytext
from docutils import nodes
from latex2mathml.converter import convert

import fourbar_codegen

HERE = Path(__file__).parent

project = "fourbar_codegen"
author = "the fourbar_codegen developers"
release = fourbar_codegen.__version__

extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc"]
html_theme = "furo"
html_show_copyright = False
html_title = f"fourbar_codegen {release}"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_js_files = ["focus.js"]
html_extra_path = ["_live"]
exclude_patterns = ["_build"]
# Both with a contrast of 4.5:1 at least.
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"
default_role = "code"

# The examples that are notebooks become pages.
for script in sorted((HERE.parent / "examples").glob("0[12]_*.py")):
    (HERE / "notebooks").mkdir(exist_ok=True)
    jupytext.write(jupytext.read(script), HERE / "notebooks" / f"{script.stem}.ipynb")

# Live pages, in the folder `pages` beside the others.
runpy.run_path(str(HERE / "live_pages.py"))["write"](HERE / "_live" / "pages")

# Pages with code are executed as they are built, and an error ends the build.
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
suppress_warnings = ["myst.header"]  # the benchmarks' tables begin below the headings of their pages
# pip builds cyipopt from source, with Ipopt and compilers of the system.
IPOPT = "howto/optimal_control"
WITHOUT_IPOPT = """```{note}
This page was built without its outputs, since Ipopt was not found. On Debian and Ubuntu:
`apt-get install coinor-libipopt-dev gfortran liblapack-dev pkg-config`.
```"""
if find_spec("cyipopt") is None:
    if os.environ.get("CI"):
        sys.exit("cyipopt is not installed: CI builds the whole documentation.")
    print(f"docs/{IPOPT}.md is built without its outputs, since Ipopt is missing.", file=sys.stderr)
    nb_execution_excludepatterns = [f"{IPOPT}.md"]
    suppress_warnings.append("myst-nb.lexer")  # cells that were not executed have no language
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
html_math_renderer = "mathml"

autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False


# Formulas as MathML, which browsers draw by themselves: pages are complete without a network.
def inline_formula(translator, node):
    """What stands for a formula within a line."""
    translator.body.append(convert(node.astext(), display="inline"))
    raise nodes.SkipNode


def displayed_formula(translator, node):
    """What stands for a formula on lines of its own."""
    translator.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode


def level_of_captions(app, pagename, templatename, context, doctree):  # noqa: ARG001  # Sphinx's
    """Sphinx calls the captions of the navigation headings without their level, which screen readers need."""
    tree = context.get("furo_navigation_tree")
    if tree:
        context["furo_navigation_tree"] = tree.replace('role="heading"', 'role="heading" aria-level="2"')


def say_what_is_missing(app, docname, source):  # noqa: ARG001  # Sphinx's
    """Readers of a page without outputs are told why."""
    if docname == IPOPT and find_spec("cyipopt") is None:
        heading = "direct collocation with Ipopt\n"
        source[0] = source[0].replace(heading, f"{heading}\n{WITHOUT_IPOPT}\n", 1)


def setup(app):
    """Make these known to Sphinx."""
    app.connect("source-read", say_what_is_missing)
    app.connect("html-page-context", level_of_captions, priority=900)
    app.add_html_math_renderer("mathml", (inline_formula, None), (displayed_formula, None))
