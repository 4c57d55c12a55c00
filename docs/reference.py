# SPDX-License-Identifier: Apache-2.0
"""Writes docs/generated/: the help of every executable and the definition of every message, from the code."""

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

DOCS = Path(__file__).resolve().parent
COLUMNS = "100"
LONGEST_START = 120  # s, on a busy machine
HEAD = {
    "commands": "# Command lines\n\nWhat `--help` of each executable says.\n",
    "messages": "# Messages\n\nThe package `piezo_gripper_msgs`. SI, temperatures in °C.\n",
}


def commands() -> str:
    """Return a page with the help of every executable."""
    parts = [HEAD["commands"]]
    for entry in sorted(entry_points(group="console_scripts"), key=lambda e: e.name):
        if not entry.value.startswith(("piezo_control.", "piezo_sim.")):
            continue
        code = f"from {entry.module} import {entry.attr} as run; import sys; sys.exit(run())"
        shown = subprocess.run(
            [sys.executable, "-c", f"import sys; sys.argv[0] = {entry.name!r}; {code}", "--help"],
            capture_output=True, text=True, timeout=LONGEST_START, check=True,
            env={**os.environ, "COLUMNS": COLUMNS},
        ).stdout  # fmt: skip
        parts.append(f"## {entry.name}\n\n```text\n{shown.rstrip()}\n```\n")
    return "\n".join(parts)


def messages() -> str:
    """Return a page with the definition of every message and action."""
    parts = [HEAD["messages"]]
    for kind in ("msg", "action"):
        for path in sorted((DOCS.parent / "msg_defs" / kind).glob(f"*.{kind}")):
            parts.append(f"## {path.stem}\n\n```text\n{path.read_text().rstrip()}\n```\n")
    return "\n".join(parts)


if __name__ == "__main__":
    folder = DOCS / "generated"
    folder.mkdir(exist_ok=True)
    for page in (commands, messages):
        (folder / f"{page.__name__}.md").write_text(page())
