# SPDX-License-Identifier: Apache-2.0
"""Every file of examples/ runs, as its docstring says, and ends with what it promises."""

import re
import subprocess
import sys
from pathlib import Path

from piezo_sim.experiment.on_nodes.processes import NodeProcesses

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name, *arguments):
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_step_on_the_engine(tmp_path):
    words = example("step_on_the_engine.py", str(tmp_path / "step.png"))
    (settled,) = re.findall(r"after ([\d.]+) ms", words)
    assert float(settled) <= 6.0  # what params/synthesis_robust.yaml asks for
    assert (tmp_path / "step.png").stat().st_size > 1000


def test_set_point(tmp_path):
    finger = ["--ros-args", "-p", "controller_file:=robust", "-r", "__ns:=/finger"]
    with NodeProcesses({"finger": finger}, tmp_path):
        words = example("set_point.py", "5e-6")
    (place,) = re.findall(r"at ([\d.]+) µm", words)
    assert abs(float(place) - 5.0) <= 0.2


def test_every_example_is_run():
    source = Path(__file__).read_text()
    assert [p.name for p in EXAMPLES.glob("*.py") if f'"{p.name}"' not in source] == []
