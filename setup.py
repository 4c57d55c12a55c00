# SPDX-License-Identifier: Apache-2.0
import os
import sys
from glob import glob
from os.path import basename, dirname, exists, join, realpath

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

NAME = "piezo_gripper"
DESCRIPTION = glob("description/*.*") + glob("description/config/*")
PARAMS = [path for path in glob("params/**", recursive=True) if path.endswith((".yaml", ".xml"))]


def shared(paths):
    """Install each path below share/piezo_gripper, in the folder it has here."""
    return [(join("share", NAME, dirname(path)), [path]) for path in sorted(paths)]


class BuildWithMessages(build_ext):
    """Refuses to build where ROS is, but not the messages: nothing would say so before a node starts."""

    def run(self):
        prefixes = list(filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
        messages = f"{NAME}_msgs"
        if prefixes and not any(exists(join(p, "share", messages)) for p in prefixes):
            root = dirname(realpath(__file__))
            sys.exit(
                f"{NAME}: the package {messages} is not there. It is in this package, where colcon and rosdep do not "
                f"look; put a link beside it and build again:\n"
                f"  ln -s {basename(root)}/msg_defs {join(dirname(root), messages)}"
            )
        super().run()


setup(
    name=NAME,
    version="0.2.0",
    description="Closed-loop control of a piezoelectric gripper finger over ROS 2 topics",
    author="piezo_gripper developers",
    maintainer="piezo_gripper developers",
    maintainer_email="piezo_gripper@example.com",
    license="Apache-2.0",
    packages=find_packages(include=["piezo_control*", "piezo_sim*"]),
    package_data={"": ["*.html", "*.j2", "*.css", "*.h"]},
    cmdclass={"build_ext": BuildWithMessages},
    ext_modules=[  # plain shared libraries, drivers of the servo
        Extension(f"piezo_control.servo.drivers.{name}", [f"piezo_control/servo/drivers/{name}.c"])
        for name in ("iio", "udp")
    ],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        *shared(
            [
                "package.xml",
                *PARAMS,
                *DESCRIPTION,
                *glob("launch/*.launch.py"),
                *glob("layouts/*"),
                *glob("msg_defs/msg/*.msg"),
            ]
        ),
    ],
    python_requires=">=3.10",
    install_requires=[
        "jinja2",
        "matplotlib",
        "mcap",  # no rosdep key: without it all works but the reading of MCAP bags
        "numpy",
        "pandas",
        "pyyaml",
        "rich",
        "rosbags",
        "scipy",
        "setuptools",
    ],
    extras_require={
        "cluster": ["distributed"],  # `monte_carlo --scheduler`
        "formats": ["fastparquet", "h5py", "npTDMS", "openpyxl"],  # recordings of other instruments
        "panel": ["bokeh"],  # `panel`
        # No rosdep key. `servo`, `commission` and `udp_finger` need it; the engine runs without, as Python, slowly.
        "fast": ["numba"],
        "synthesis": ["slycot"],  # GPL-2.0; its rosdep rule would put NumPy 2 over Jazzy's NumPy 1
        "test": [
            "control",
            "coverage",
            "hypothesis",
            "mypy",
            "pytest",
            "pytest-xdist",
            "ruff",
            "types-PyYAML",
        ],
    },
    zip_safe=True,
    entry_points={
        "console_scripts": [
            "cantilever = piezo_sim.start:cantilever",
            "temperature = piezo_sim.start:temperature",
            "feedforward = piezo_control.start:feedforward",
            "feedback = piezo_control.start:feedback",
            "fingerctl = piezo_control.start:fingerctl",
            "finger = piezo_sim.start:finger",
            "recorder = piezo_control.start:recorder",
            "experiment = piezo_sim.start:experiment",
            "identify = piezo_control.start:identify",
            "synthesize = piezo_control.start:synthesize",
            "servo = piezo_control.start:servo",
            "export = piezo_control.start:export",
            "commission = piezo_control.start:commission",
            "udp_finger = piezo_sim.start:udp_finger",
            "gripper = piezo_control.start:gripper",
            "panel = piezo_control.start:panel",
            "gripper_stack = piezo_sim.start:gripper_stack",
            "monte_carlo = piezo_sim.start:monte_carlo",
        ],
        "piezo_gripper.drivers": ["simulated = piezo_sim.driver:Simulation"],
    },
)
