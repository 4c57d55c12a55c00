# SPDX-License-Identifier: Apache-2.0
from glob import glob
from os.path import dirname, join

from setuptools import find_packages, setup

NAME = "piezo_gripper"
PARAMS = [path for path in glob("params/**", recursive=True) if path.endswith((".yaml", ".xml"))]


def shared(paths):
    """Install each path below share/piezo_gripper, in the folder it has here."""
    return [(join("share", NAME, dirname(path)), [path]) for path in sorted(paths)]


setup(
    name=NAME,
    version="0.2.0",
    description="Closed-loop control of a piezoelectric gripper finger over ROS 2 topics",
    author="piezo_gripper developers",
    maintainer="piezo_gripper developers",
    maintainer_email="piezo_gripper@example.com",
    license="Apache-2.0",
    packages=find_packages(include=["piezo_control*", "piezo_sim*"]),
    package_data={"": ["*.html", "*.j2", "*.css"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        *shared(["package.xml", *PARAMS, *glob("launch/*.launch.py"), *glob("msg_defs/msg/*.msg")]),
    ],
    python_requires=">=3.10",
    install_requires=[
        "control",
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
        "fast": ["numba"],  # no rosdep key: without it the engine runs as Python, slowly
        "synthesis": ["slycot"],  # GPL-2.0: needed by `synthesize` alone
        "test": ["coverage", "hypothesis", "mypy", "pytest", "ruff", "types-PyYAML"],
    },
    zip_safe=True,
    entry_points={
        "console_scripts": [
            "cantilever = piezo_sim.nodes.cantilever:main",
            "temperature = piezo_sim.nodes.temperature:main",
            "feedforward = piezo_control.nodes.feedforward:main",
            "feedback = piezo_control.nodes.feedback:main",
            "finger = piezo_sim.nodes.all_in_one:main",
            "recorder = piezo_control.nodes.recorder:main",
            "experiment = piezo_sim.experiment.cli:main",
            "identify = piezo_control.identification.cli:main",
            "synthesize = piezo_control.design.cli:main",
            "gripper = piezo_control.nodes.gripper:main",
            "monte_carlo = piezo_sim.experiment.monte_carlo:main",
        ],
    },
)
