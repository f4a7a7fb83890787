"""How the documentation is built: `make docs`."""

import fourbar_codegen

project = "fourbar_codegen"
author = "the fourbar_codegen developers"
release = fourbar_codegen.__version__

extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = f"fourbar_codegen {release}"
exclude_patterns = ["_build"]
default_role = "code"

# Pages with code are executed as they are built, and an error ends the build.
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
myst_enable_extensions = ["dollarmath"]
suppress_warnings = ["myst.header"]  # the benchmarks' tables begin below the headings of their pages

autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
