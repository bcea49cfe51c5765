"""Sphinx settings of the documentation site: `make docs`."""

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "robomme-interference-data"
author = "The RoboMME-Interference authors"
project_copyright = "2026, the RoboMME-Interference authors. Apache-2.0"
version = release = metadata.version(project)

extensions = [
    "myst_nb",  # pages in Markdown, and the tutorial, a notebook
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",  # docstrings in Google's style
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "reference_pages",  # _ext/: reference/generated/ from the code's own declarations
]
exclude_patterns = ["build", "pictures/*.py"]
nitpicky = False  # types of NumPy and of the standard library have no pages here
html_theme = "furo"
html_title = "RoboMME-Interference"
html_static_path = ["_static"]
html_css_files = ["site.css"]

# Docstrings are written in Markdown's way: `name` is code.
default_role = "literal"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_use_rtype = False

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # tests/system/test_docs.py executes the tutorial
copybutton_prompt_text = r">>> |\$ "
copybutton_prompt_is_regexp = True
suppress_warnings = ["mystnb.unknown_mime_type"]
