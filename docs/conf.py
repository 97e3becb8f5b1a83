"""Settings of the documentation's site (Sphinx); ``sh docs/build.sh`` builds it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import torch_modal

project = "torch_modal"
author = "torch_modal contributors"
copyright = author
version = release = torch_modal.__version__

extensions = [
    "myst_nb",  # Markdown pages, and notebooks with the outputs that they are stored with
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "extension",  # beside this file: what is generated from the package
]
exclude_patterns = ["README.md"]
highlight_language = "none"  # of indented blocks: equations, tables, output
nb_execution_mode = "off"  # tests/project/test_docs.py runs them
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
html_math_renderer = "mathml"  # of extension.py; MathJax would need a network
suppress_warnings = ["mystnb.unknown_mime_type"]

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = "torch_modal"
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = "$ "
