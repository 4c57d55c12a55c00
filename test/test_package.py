# SPDX-License-Identifier: Apache-2.0
"""The packages as built and installed: versions, dependencies, executables, data, messages."""

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from packaging.requirements import Requirement
from rclpy.serialization import deserialize_message, serialize_message

from piezo_control import start

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
MESSAGES_MANIFEST = ElementTree.parse(ROOT / "msg_defs" / "package.xml").getroot()
EXECUTABLES = {
    "cantilever",
    "temperature",
    "feedforward",
    "feedback",
    "fingerctl",
    "recorder",
    "experiment",
    "identify",
    "synthesize",
    "monte_carlo",
    "gripper",
    "panel",
    "gripper_stack",
    "servo",
    "commission",
    "export",
    "udp_finger",
}

# From ros/rosdistro: packages released into jazzy/distribution.yaml ...
JAZZY_PACKAGES = {
    "action_msgs",
    "ament_cmake",
    "ament_index_python",
    "builtin_interfaces",
    "control_msgs",
    "diagnostic_msgs",
    "geometry_msgs",
    "launch",
    "launch_ros",
    "lifecycle_msgs",
    "rcl_interfaces",
    "rclpy",
    "ros2launch",
    "rosgraph_msgs",
    "rosidl_default_generators",
    "rosidl_default_runtime",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "trajectory_msgs",
    "xacro",
}
# ... and keys of rosdep/python.yaml that resolve on Ubuntu noble. There is no key for mcap, none for
# numba that noble has a package for, and that for control does not begin with python3.
ROSDEP_KEYS = {
    "python-control-pip",
    "python3-hypothesis",
    "python3-jinja2",
    "python3-matplotlib",
    "python3-numpy",
    "python3-pandas",
    "python3-pytest",
    "python3-pytest-xdist",
    "python3-rich",
    "python3-rosbags-pip",
    "python3-ruff-pip",
    "python3-scipy",
    "python3-yaml",
}
JAZZY_PINS = (ROOT / "requirements" / "jazzy.txt").read_text()


def setup_keywords() -> dict[str, ast.expr]:
    """Return the keyword arguments of the call of `setup` in setup.py, unevaluated."""
    calls = (
        n for n in ast.walk(ast.parse((ROOT / "setup.py").read_text())) if isinstance(n, ast.Call)
    )
    call = next(c for c in calls if getattr(c.func, "id", "") == "setup")
    return {keyword.arg: keyword.value for keyword in call.keywords}


def test_one_version_everywhere():
    versions = {
        "package.xml": MANIFEST.findtext("version"),
        "msg_defs/package.xml": MESSAGES_MANIFEST.findtext("version"),
        "setup.py": ast.literal_eval(setup_keywords()["version"]),
        "as installed": importlib.metadata.version("piezo_gripper"),
    }
    assert len(set(versions.values())) == 1, versions


@pytest.mark.parametrize(
    "manifest", [MANIFEST, MESSAGES_MANIFEST], ids=lambda m: m.findtext("name")
)
def test_dependencies_have_rosdep_keys(manifest):
    dependencies = {e.text for e in manifest if e.tag == "depend" or e.tag.endswith("_depend")}
    assert dependencies - JAZZY_PACKAGES - ROSDEP_KEYS - {"piezo_gripper_msgs"} == set()


def test_what_rosdep_installs_by_pip_runs_with_the_numpy_of_jazzy():
    keys = {e.text for e in MANIFEST if e.tag.endswith("_depend") and e.text.endswith("-pip")}
    numpy = re.search(r"^numpy==(\S+)", JAZZY_PINS, re.MULTILINE)[1]
    assert keys
    for key in keys:
        package = re.fullmatch(r"python3?-(.+)-pip", key)[1]
        for requirement in map(Requirement, importlib.metadata.requires(package) or []):
            if requirement.name == "numpy":
                assert numpy in requirement.specifier, (package, requirement)


def test_imported_ros_packages_are_declared():
    sources = [
        p.read_text() for d in ("piezo_control", "piezo_sim") for p in (ROOT / d).rglob("*.py")
    ]
    imported = {
        name
        for text in sources
        for name in re.findall(r"^\s*(?:from|import) (\w+)", text, re.MULTILINE)
    }
    declared = {e.text for e in MANIFEST if e.tag == "exec_depend"}
    assert (imported & JAZZY_PACKAGES) - declared == set()


def test_executables_are_installed():
    scripts = ast.literal_eval(setup_keywords()["entry_points"])["console_scripts"]
    declared = {script.partition("=")[0].strip() for script in scripts}
    folder = Path(get_package_prefix("piezo_gripper"), "lib", "piezo_gripper")
    installed = {path.name for path in folder.iterdir() if os.access(path, os.X_OK)}
    assert declared >= EXECUTABLES
    assert installed == declared


def test_every_executable_begins_where_a_missing_package_is_told():
    for script in importlib.metadata.entry_points(group="console_scripts"):
        if script.dist.name == "piezo_gripper":
            assert script.load().__qualname__ == start.executable("").__qualname__, script


def test_every_imported_package_is_declared_or_of_ros():
    sources = [p for d in ("piezo_control", "piezo_sim") for p in (ROOT / d).rglob("*.py")]
    imported = {
        name.split(".")[0]
        for path in sources
        for node in ast.walk(ast.parse(path.read_text()))
        for name in (
            [alias.name for alias in node.names] if isinstance(node, ast.Import)
            else [node.module] if isinstance(node, ast.ImportFrom)
            else []
        )
    } - sys.stdlib_module_names - {"piezo_control", "piezo_sim"}  # fmt: skip
    assert {"bokeh", "llvmlite", "numba", "rclpy", "slycot", "yaml"} <= imported
    for name in imported:
        of_ros = name in JAZZY_PACKAGES | {"piezo_gripper_msgs"}
        assert ("source the setup.bash" in start.how_to_get(name)) == of_ros, name


@pytest.mark.parametrize(
    "executable, absent, said",
    [
        ("servo", "numba", "needs numba: pip install numba"),
        ("servo", "llvmlite", "needs numba: pip install numba"),
        ("commission", "numba", "needs numba: pip install numba"),
        ("udp_finger", "numba", "needs numba: pip install numba"),
        ("panel", "tornado", "needs bokeh: pip install bokeh"),
        ("cantilever", "rosgraph_msgs", "needs rosgraph_msgs: source the setup.bash of ROS 2"),
        ("fingerctl", "rclpy", "needs rclpy: source the setup.bash of ROS 2"),
    ],
)
def test_a_missing_package_is_named_with_how_to_get_it(executable, absent, said):
    done = without(absent, executable, "--help")
    assert done.returncode == 1
    assert done.stderr.startswith(f"{executable}: {said}")
    assert done.stderr.count("\n") == 1


def test_firmware_is_exported_without_a_compiler_of_python(tmp_path):
    done = without("numba", "export", "--out", str(tmp_path / "firmware"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "firmware" / "finger.c").exists()


def without(absent, executable, *arguments):
    """Run an executable where a package is not installed."""
    (script,) = importlib.metadata.entry_points(group="console_scripts", name=executable)
    blocked = f"""
import importlib.abc, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, *_):
        if name.split(".")[0] == {absent!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
sys.argv[0] = {executable!r}
from {script.module} import {script.attr}
sys.exit({script.attr}())
"""
    return subprocess.run(
        [sys.executable, "-c", blocked, *arguments], capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize(
    "pattern",
    [
        "params/**/*.yaml",
        "params/**/*.xml",
        "launch/*.launch.py",
        "description/**/*.*",
        "layouts/*",
    ],
)
def test_data_files_are_installed_as_they_are(pattern):
    share = Path(get_package_share_directory("piezo_gripper"))
    here = {p.relative_to(ROOT): p.read_bytes() for p in ROOT.glob(pattern)}
    there = {p.relative_to(share): p.read_bytes() for p in share.glob(pattern)}
    assert there == here


def test_every_message_survives_serialization():
    messages = __import__("piezo_gripper_msgs.msg").msg
    names = [path.stem for path in (ROOT / "msg_defs" / "msg").glob("*.msg")]
    assert names
    for name in names:
        message = getattr(messages, name)()
        message.header.frame_id = "finger"
        message.header.stamp.sec = 7
        assert deserialize_message(serialize_message(message), type(message)) == message


def test_a_build_without_the_messages_says_what_to_type(tmp_path):
    build = subprocess.run(
        [sys.executable, "setup.py", "build_ext", "--build-temp", tmp_path, "--build-lib", tmp_path],
        cwd=ROOT, env={**os.environ, "AMENT_PREFIX_PATH": str(tmp_path)}, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert build.returncode == 1
    line = f"ln -s {ROOT.name}/msg_defs {ROOT.parent / 'piezo_gripper_msgs'}"
    assert build.stderr.splitlines()[-1].strip() == line


def test_clean_removes_what_was_built_and_nothing_else(tmp_path):
    drivers = tmp_path / "piezo_control" / "servo" / "drivers"
    built = [
        "build",
        "install",
        "log",
        "docs/generated",
        *(drivers / f"{n}.cpython-311-x.so" for n in ("udp", "iio")),
    ]
    mine = [drivers / "my_driver.so", "docs/index.md", ".venv/bin/python", "out/step/report.html"]
    for path in (*built, *mine):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    for goal, kept in (("clean", mine), ("distclean", mine[:2])):
        subprocess.run(["make", "-f", ROOT / "Makefile", goal], cwd=tmp_path, check=True)
        assert [path for path in (*built, *mine) if (tmp_path / path).exists()] == kept
