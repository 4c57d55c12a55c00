# SPDX-License-Identifier: Apache-2.0
"""The first hour: what README and docs tell a newcomer to type is typed, line by line, in a shell."""

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TIMEOUT = 300.0  # s, for all lines of a page on a busy machine
STAYS = ("cantilever ", "feedforward ", "feedback ", "finger ", "recorder ")  # until it is stopped
# Tested where they have what they need, a gripper or minutes: test_gripper_stack, test_package.
ELSEWHERE = ("make ", "fingerctl grip ")

pytestmark = pytest.mark.skipif(
    not (ROOT / "install" / "sources").exists(), reason="the pages are typed after `make env`"
)


def typed(page, section=""):
    """Return the lines of the shell in the part of a page that begins with `section`."""
    text = (ROOT / page).read_text()
    text = text[text.index(section) :]
    if section:
        text = text[: text.find("\n## ", 1)]
    lines = []
    for block in re.findall(r"^```\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL):
        lines += [line.split(" #")[0].strip() for line in block.splitlines()]
    return [line for line in lines if line and not line.startswith(ELSEWHERE)]


def run(lines, folder):
    """Run lines in a shell as one types them; end with everything that they started."""
    script = ["set -e"]
    for line in lines:
        if line.startswith(STAYS) and not line.endswith(("--help", "&")):
            line += " &"
        if line == "fingerctl watch":
            line = "timeout -s INT 3 fingerctl watch || [ $? = 124 ]"  # until Ctrl-C
        script += [f"cd {ROOT}", line] if line.startswith(". ") else [f"cd {folder}", line]
    shell = subprocess.Popen(
        ["bash", "-c", "\n".join(script)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True, env=os.environ | {"COLUMNS": "120"},
    )  # fmt: skip
    try:
        # Nodes keep the output open, so the shell's end is what is waited for.
        code = shell.wait(TIMEOUT)
    finally:
        os.killpg(shell.pid, signal.SIGTERM)
    said, _ = shell.communicate(timeout=TIMEOUT)
    assert code == 0, said
    assert "Traceback" not in said
    return said


def test_first_loop(tmp_path):
    said = run(typed("docs/first_loop.md"), tmp_path)
    assert "/finger: at 10.0" in said or "/finger: at 9.9" in said
    assert "running" in said


def test_readme_single_nodes(tmp_path):
    lines = typed("README.md", "## Single nodes")
    separate = lines[: lines.index("finger --ros-args -p controller_file:=robust -r __ns:=/finger")]
    said = run([*separate, "fingerctl set 5 --wait"], tmp_path)
    assert "answers '/finger/command'" in said
    together = lines[len(separate) : next(i for i, x in enumerate(lines) if x.startswith("ln "))]
    said = run([". ./setup.bash", *together], tmp_path)
    assert "running, at sample 1" in said


def test_fingerctl(tmp_path):
    said = run(typed("docs/fingerctl.md"), tmp_path)
    assert "/finger: cantilever, feedback, feedforward" in said
    assert "/finger/feedback: inactive" in said
    assert (tmp_path / "bags" / "first" / "metadata.yaml").exists()
