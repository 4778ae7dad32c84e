"""Sphinx's settings of the documentation site: `make site` builds it into demo/site.

All text is written elsewhere: `pages.py` collects it.
"""

from importlib import metadata

project = "lmshealth"
release = metadata.version("lmshealth")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"lmshealth {release}"
html_show_sphinx = False
html_copy_source = False
html_show_search_summary = False  # a page in a folder may not read others

# Anchors of headings as on the pages of a repository; links to missing ones are warnings.
myst_heading_anchors = 4
suppress_warnings = [
    "myst.header",  # notebooks begin with any level
    "misc.highlighting_failure",  # output of programs
]
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False}
python_use_unqualified_type_names = True
add_module_names = False
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_param = False  # types are words, not names
napoleon_use_ivar = True  # fields are described by the class or beside them, not twice
