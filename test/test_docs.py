# SPDX-License-Identifier: Apache-2.0
"""The pages say what the code declares, and nothing that they name is missing."""

import json
import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from piezo_control.nodes.parameters import RECORDED

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def test_parameter_tables_are_current():
    pytest.importorskip("numba")  # the servo's node imports it
    page = runpy.run_path(str(DOCS / "parameters.py"))["page"]()
    assert (DOCS / "parameters.md").read_text() == page, "run `python docs/parameters.py`"


def test_every_page_is_in_the_site_and_every_link_to_a_page_leads_somewhere():
    index = (DOCS / "index.md").read_text()
    listed = {
        line for block in re.findall(r"```{toctree}(.*?)```", index, re.S) for line in block.split()
    }
    pages = {path.stem for path in DOCS.glob("*.md")} - {"index"}
    assert pages <= listed
    for path in DOCS.glob("*.md"):
        for target in re.findall(r"\]\(([^)#:]+\.md)(?:#[^)]*)?\)", path.read_text()):
            assert target.startswith("generated/") or (DOCS / target).exists(), (
                f"{path.name}: {target}"
            )


def test_every_pinned_package_is_in_the_table_of_licences():
    pinned = runpy.run_path(str(DOCS / "dependencies.py"))["pinned"]()
    page = (DOCS / "dependencies.md").read_text()
    assert [name for name in pinned if name not in page] == []


def curves():
    """Topic and field of every curve of the layouts."""
    foxglove = json.loads((ROOT / "layouts" / "foxglove.json").read_text())
    for panel in foxglove["configById"].values():
        yield from (path["value"].rpartition(".")[::2] for path in panel.get("paths", ()))
    for curve in ElementTree.parse(ROOT / "layouts" / "plotjuggler.xml").iter("curve"):
        yield curve.get("name").rpartition("/")[::2]


@pytest.mark.parametrize("topic, field", sorted(set(curves())))
def test_layouts_show_what_is_recorded(topic, field):
    assert topic.removeprefix("/finger/") in RECORDED
    if field != "temperature":
        assert f"float64 {field}\n" in (ROOT / "msg_defs" / "msg" / "Sample.msg").read_text()
