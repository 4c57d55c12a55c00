# SPDX-License-Identifier: Apache-2.0
"""Writes docs/parameters.md from the declarations in the code: nodes, `synthesize`, experiments."""

from collections.abc import Mapping
from pathlib import Path

from piezo_control.design.problem import DesignProblem
from piezo_control.nodes.base import describe
from piezo_control.nodes.feedback import FeedbackNode
from piezo_control.nodes.feedforward import FeedforwardNode
from piezo_control.nodes.gripper import GripperNode
from piezo_control.nodes.recorder import RecorderNode
from piezo_control.nodes.servo import ServoNode
from piezo_control.parameters import declarations
from piezo_sim.experiment.cases import EXPERIMENT_KEYS, RUN_KEYS
from piezo_sim.nodes.cantilever import CantileverNode
from piezo_sim.nodes.temperature import TemperatureNode

NODES = (
    CantileverNode, TemperatureNode, FeedforwardNode, FeedbackNode, ServoNode, RecorderNode, GripperNode,
)  # fmt: skip
LONGEST = 40  # characters of a default that a table still shows
HEAD = """# Parameters

Written by `python docs/parameters.py` from the declarations in the code; `NODE --help` prints the same. Every node
has `autostart` (default true: configure and activate at start) besides.
"""


def table(title: str, cls: type) -> str:
    """Return the parameters that a dataclass declares as a Markdown table."""
    lines = [f"## {title}", "", "| parameter | default | meaning |", "| --- | --- | --- |"]
    for name, (kind, field) in declarations(cls).items():
        default = str(list(field.default) if isinstance(field.default, tuple) else field.default)
        if len(default) > LONGEST:
            default = f"{len(field.default)} entries"
        meaning = describe(name, kind, field).description.replace("|", "\\|")
        lines.append(f"| `{name}` | {default} | {meaning} |")
    return "\n".join(lines) + "\n"


def keys(title: str, meanings: Mapping[str, str]) -> str:
    """Return the keys of a YAML file as a Markdown table."""
    lines = [f"## {title}", "", "| key | meaning |", "| --- | --- |"]
    return "\n".join([*lines, *(f"| `{key}` | {text} |" for key, text in meanings.items())]) + "\n"


def page() -> str:
    """Return the whole page."""
    return "\n".join(
        [
            HEAD,
            *(table(node.NAME, node.PARAMETERS) for node in NODES),
            table("synthesize (its YAML file)", DesignProblem),
            keys("An experiment's YAML file (params/experiments)", EXPERIMENT_KEYS),
            keys("A run of an experiment", RUN_KEYS),
        ]
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page())
