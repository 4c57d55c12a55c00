# SPDX-License-Identifier: Apache-2.0
"""Networks that a node does not hear, because they came up after it had started.

Fast DDS looks for the interfaces of its machine when a process joins the domain, and talks through these from then
on. A node that starts before a cable is plugged in, or before the wireless network has an address, waits for the
nodes of other machines for ever.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class Networks:
    """The networks that were up when the process started, seen from Linux' table of interfaces."""

    def __init__(self) -> None:
        self._heard = self._up()

    def missed(self) -> str:
        """Say which networks came up since, and what helps; empty: none, or this node looks at its own machine only."""
        if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") in ("LOCALHOST", "OFF"):
            return ""
        names = ", ".join(f"'{name}'" for name in sorted(self._up() - self._heard))
        if not names:
            return ""
        return f"network {names} came up after this node started, which hears nobody there: start it again"

    @staticmethod
    def _up() -> set[str]:
        found = set()
        for state in Path("/sys/class/net").glob("*/operstate"):
            with contextlib.suppress(OSError):  # of an interface that goes while it is looked at
                if state.read_text().strip() == "up":
                    found.add(state.parent.name)
        return found
