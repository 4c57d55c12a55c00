# SPDX-License-Identifier: Apache-2.0
"""The house stands: imports run one way, ROS is needed by nodes only, every file has its licence."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Bottom to top; the longest matching name counts. A module imports from its own level or below.
LEVELS = [
    {
        "parameters",
        "profile",
        "waveform",
        "metrics",
        "safety",
        "sequence",
        "shared",
        "compiled",
        "start",
        "options",
        "files",
        "report",
    },
    {
        "hysteresis",
        "dynamics",
        "creep",
        "thermal",
        "adaptation",
        "feedback",
        "touch",
        "gripper",
        "recording",
    },
    {"shaping", "feedforward", "sensorless", "thermometer", "design"},
    {"identification", "servo"},
    {"nodes", "export", "panel"},
    {"plant", "temperature"},
    {"engine", "sim_nodes", "driver", "udp_finger"},
    {"experiment"},
]
LEVEL_OF = {name: level for level, names in enumerate(LEVELS) for name in names}
ROS = {
    "rclpy", "ament_index_python", "rcl_interfaces", "lifecycle_msgs", "piezo_gripper_msgs",
    "rosgraph_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs", "control_msgs", "launch", "launch_ros",
}  # fmt: skip

MODULES = sorted(
    path.relative_to(ROOT)
    for package in ("piezo_control", "piezo_sim")
    for path in (ROOT / package).rglob("*.py")
    if path.name != "__init__.py"
)


def imported(path: Path) -> set[str]:
    """Return the dotted names that a file imports, inside functions too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def level(dotted: str) -> int:
    """Return the level of a module, or of a name in one."""
    package, room = dotted.split(".")[:2]
    return LEVEL_OF["sim_nodes" if (package, room) == ("piezo_sim", "nodes") else room]


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_imports_run_one_way(path):
    own = level(".".join(path.with_suffix("").parts))
    wrong = [
        name
        for name in imported(path)
        if name.startswith(("piezo_control.", "piezo_sim.")) and level(name) > own
    ]
    assert wrong == []


def test_the_control_package_knows_nothing_of_the_simulation():
    for path in MODULES:
        if path.parts[0] == "piezo_control":
            assert [n for n in imported(path) if n.startswith("piezo_sim")] == [], path


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_only_nodes_and_what_starts_them_need_ros(path):
    if "nodes" in path.parts or "on_nodes" in path.parts:
        pytest.skip("a node")
    assert {name.split(".")[0] for name in imported(path)} & ROS == set()


@pytest.mark.parametrize(
    "command",
    [
        ["piezo_sim.experiment.cli", "step", "--engine", "--out", "{out}"],
        ["piezo_control.identification.cli", "--help"],
        ["piezo_control.design.cli", "--help"],
        ["piezo_control.export.cli", "--out", "{out}"],
    ],
    ids=lambda command: command[0],
)
def test_works_on_a_machine_without_ros(command, tmp_path):
    blocked = f"""
import sys
class NoRos:
    def find_spec(self, name, *_):
        if name.split(".")[0] in {ROS!r}:
            raise ModuleNotFoundError(f"no ROS on this machine: {{name}}")
sys.meta_path.insert(0, NoRos())
module, sys.argv = sys.argv[1], sys.argv[1:]
import importlib
sys.exit(importlib.import_module(module).main())
"""
    arguments = [argument.format(out=tmp_path / "out") for argument in command]
    done = subprocess.run(
        [sys.executable, "-c", blocked, *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr


def test_every_file_names_its_licence():
    tracked = subprocess.run(
        ["git", "ls-files", "*.py", "*.sh", "*.bash"], cwd=ROOT, capture_output=True, text=True
    ).stdout.split()
    assert tracked
    unnamed = [
        name
        for name in tracked
        if (ROOT / name).stat().st_size
        and "SPDX-License-Identifier: Apache-2.0" not in (ROOT / name).read_text()[:200]
    ]
    assert unnamed == []


def test_a_number_of_the_finger_stands_in_one_place():
    """D(s) (eq. 5), its reach and its sample time are written once; all else refers to that."""
    places: dict[float, set[str]] = {5.7e-8: set(), 8.1e-6: set(), 22e-6: set()}
    for path in MODULES:
        tree = ast.parse((ROOT / path).read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in places:
                places[node.value].add(str(path))
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "parameter":
                units = [ast.unparse(k.value) for k in node.keywords if k.arg == "unit"]
                assert ast.unparse(node.args[0]) != "0.0001" or units != ["'s'"], path
    dynamics = {"piezo_control/dynamics.py"}
    assert places == {5.7e-8: dynamics, 8.1e-6: dynamics, 22e-6: set()}
