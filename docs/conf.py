# SPDX-License-Identifier: Apache-2.0
"""Sphinx's configuration: the pages of this folder, and what reference.py writes from the code."""

import runpy
from pathlib import Path

from piezo_control.shared import version as package_version

project = "piezo_gripper"
author = "piezo_gripper developers"
project_copyright = author
release = version = package_version()

extensions = ["myst_parser", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"{project} {release}"
html_static_path = []
html_copy_source = False
linkcheck_timeout = 20

runpy.run_path(str(Path(__file__).parent / "reference.py"), run_name="__main__")
