# SPDX-License-Identifier: Apache-2.0
"""The generated page of parameters says what the code declares."""

import runpy
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


def test_parameter_tables_are_current():
    page = runpy.run_path(str(DOCS / "parameters.py"))["page"]()
    assert (DOCS / "parameters.md").read_text() == page, "run `python docs/parameters.py`"
