# SPDX-License-Identifier: Apache-2.0
"""Where the files that come with the package are: parameters, message definitions, layouts; its version."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

PACKAGE = "piezo_gripper"


def shared_folder() -> Path:
    """Return the folder that holds `params` and `msg_defs`, found without ROS.

    In a checkout, that is the folder of the two Python packages; where the package is installed, it is
    share/piezo_gripper of the same prefix, as ROS 2 lays it out.

    Raises FileNotFoundError when the installation is incomplete.
    """
    here = Path(__file__).resolve()
    places = [here.parents[1], *(parent / "share" / PACKAGE for parent in here.parents)]
    for place in places:
        if (place / "params").is_dir():
            return place
    raise FileNotFoundError(f"no 'params' beside {here.parents[1]}: the installation is incomplete")


def version() -> str:
    """Return the version of the package, as package.xml has it."""
    return str(ElementTree.parse(shared_folder() / "package.xml").findtext("version"))
