# SPDX-License-Identifier: Apache-2.0
"""Writes docs/parameters.md, the tables of every node's parameters, from their declarations."""

from pathlib import Path

from piezo_control.nodes.base import FingerNode, describe
from piezo_control.nodes.feedback import FeedbackNode
from piezo_control.nodes.feedforward import FeedforwardNode
from piezo_control.nodes.recorder import RecorderNode
from piezo_control.parameters import declarations
from piezo_sim.nodes.cantilever import CantileverNode
from piezo_sim.nodes.temperature import TemperatureNode

NODES = (CantileverNode, TemperatureNode, FeedforwardNode, FeedbackNode, RecorderNode)
LONGEST = 40  # characters of a default that a table still shows


def table(node: type[FingerNode]) -> str:
    """Return the node's parameters as a Markdown table."""
    lines = [f"## {node.NAME}", "", "| parameter | default | meaning |", "| --- | --- | --- |"]
    for name, (kind, field) in declarations(node.PARAMETERS).items():
        default = str(list(field.default) if isinstance(field.default, tuple) else field.default)
        if len(default) > LONGEST:
            default = f"{len(field.default)} numbers"
        meaning = describe(name, kind, field).description.replace("|", "\\|")
        lines.append(f"| `{name}` | {default} | {meaning} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """Return the whole page."""
    head = (
        "# Parameters of the nodes\n\nWritten by `python docs/parameters.py` from the declarations in the "
        "code; `NODE --help` prints the same. Every node has `autostart` (default true: configure and "
        "activate at start) besides.\n"
    )
    return "\n".join([head, *map(table, NODES)])


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page())
