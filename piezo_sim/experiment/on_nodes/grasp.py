# SPDX-License-Identifier: Apache-2.0
"""Pick a glass bead, hold it while it gets warm, carry it and place it: by force, by position, by feedforward alone.

Starts two simulated fingers with their recorders and the gripper in front of them, and drives that by the client
class. The bead is an object in front of each tip: its middle stays in the middle, as it does between two fingers
that are alike.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import yaml
from rich.console import Console

from piezo_control.dynamics import DynamicsParameters
from piezo_control.nodes.client import ClientError, Finger, Gripper, connect
from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import SAMPLE_TYPE, Recording, read
from piezo_control.report.page import Section
from piezo_gripper_msgs.msg import FingerState
from piezo_sim.experiment import study
from piezo_sim.experiment.cases import RunFailed
from piezo_sim.experiment.on_nodes.conductor import alone
from piezo_sim.experiment.on_nodes.processes import NodeProcesses
from piezo_sim.experiment.plots import save
from piezo_sim.plant.cantilever import CantileverParameters

SIDES = ("left", "right")
BEAD = 50e-6  # m
REST_OPENING = 60e-6  # m, between the tips at rest: the bead fits in
# Hertz for glass (70 GPa) of this radius on a stiff tip: about 4.5e4 N/m around 0.5 mN.
STIFFNESS, DAMPING = 4.5e4, 0.05  # N/m, N s/m
FORCE = 0.5e-3  # N, asked for
# Fingers that feel nothing are sent so far into the bead on each side that a free tip bends back with that force.
DEEP = FORCE * DynamicsParameters.elastic_constant  # m
SPEED = 200e-6  # m/s
SAMPLE_TIME = CantileverParameters().sample_time
HELD_FROM = 2.0  # s of the fingers' time; from then on it gets warm
WARMING = {
    "profile": "ramp",
    "base_degc": 22.0,
    "amplitude_degc": 10.0,
    "start": HELD_FROM,
    "duration": 4.0,
}
CARRIED_UNTIL = 8.0  # s
ANSWER = 400.0  # s that the nodes may take on a busy machine

TEXT = (
    "A glass bead stands between two tips, as stiff as Hertz has it. By force, the fingers are asked to close with "
    "0.5 mN and to hold that; by position and by feedforward alone they are sent 1.55 µm into the bead, which is "
    "0.5 mN of a tip. The body of the fingers follows the thermocouple's 10 °C with its time constant. True forces."
)


@dataclass(frozen=True)
class Way:
    """A way to hold: parameters of the fingers' nodes, and whether these feel a force."""

    title: str
    feedback: dict[str, Any]
    feedforward: dict[str, Any]
    feels: bool = False


WARM_MODELS = {"compensator": "sensorless", "temperature_lockstep": True}
WAYS = {
    "force": Way("force control", {"force_control": True}, WARM_MODELS, feels=True),
    "position": Way("position control", {"controller_file": "robust"}, {}),
    "feedforward": Way("feedforward alone", {}, {}),
}


class Grasp(NamedTuple):
    """What was recorded of one finger."""

    finger: Recording
    force: Signal  # of the bead, N
    push: Signal  # what the finger takes for it, N


class Signal(NamedTuple):
    """Values over the finger's time (s)."""

    time: np.ndarray
    value: np.ndarray


def parameters(way: Way, out: Path) -> Path:
    """Write the parameter file of all nodes, and return it."""
    contact = {"stiffness": STIFFNESS, "damping": DAMPING, "free_play": (REST_OPENING - BEAD) / 2.0}
    nodes = {
        "cantilever": {"contact": contact, "temperature_lockstep": True, "reply_timeout": 60.0, "subscribers": 2},
        "temperature": WARMING,
        "feedforward": way.feedforward,
        "feedback": way.feedback,
        # Lock-step waits for a busy machine, longer than anybody would for a real finger.
        "gripper": {"rest_opening": REST_OPENING, "state_timeout": 20.0},
        "recorder": {"topics": ["deflection", "command", "voltage", "temperature", "reference_profile",
                                "push", "contact_force", "state"]},
    }  # fmt: skip
    file = out / "parameters.yaml"
    file.write_text(yaml.safe_dump({f"/**/{n}": {"ros__parameters": p} for n, p in nodes.items()}))
    return file


def run(way: Way, out: Path) -> dict[str, Path]:
    """Pick, hold, carry and place in this way; return the bag of each finger."""
    out.mkdir(parents=True)
    words = ["--ros-args", "--params-file", str(parameters(way, out))]
    bags = {side: out / side for side in SIDES}
    with ExitStack() as stack:
        started = []
        for side in SIDES:
            own = [*words, "-r", f"__ns:=/{side}"]
            commands = {"recorder": [*own, "-p", f"bag:={bags[side]}"], "finger": own}
            started.append(stack.enter_context(NodeProcesses(commands, out / "log" / side)))
        started.append(stack.enter_context(NodeProcesses({"gripper": words}, out / "log")))
        ros = stack.enter_context(connect(ANSWER))
        fingers = [ros.finger(side) for side in SIDES]
        for finger in fingers:
            finger.wait_for(partial(is_running, finger))
        pick_and_place(ros.gripper(), fingers, way)
        for finger in fingers:
            finger.end_record()
        for processes in started:
            processes.check()
    return bags


def is_running(finger: Finger) -> bool:
    """Say whether the finger's loop runs."""
    return finger.state is not None and finger.state.phase == FingerState.RUNNING


def is_past(finger: Finger, time: float) -> bool:
    """Say whether the finger's own time has passed `time` (s)."""
    if not is_running(finger):
        raise RunFailed(f"finger '{finger.namespace}' is {finger.words()}")
    return finger.state is not None and finger.state.samples * SAMPLE_TIME > time


def pick_and_place(gripper: Gripper, fingers: list[Finger], way: Way) -> None:
    """Pick the bead, wait until it has been held and carried, and let it go."""
    if way.feels:
        gripper.grasp(FORCE, SPEED)
    else:
        gripper.move(BEAD - 2.0 * DEEP, SPEED)
    for finger in fingers:
        finger.wait_for(partial(is_past, finger, CARRIED_UNTIL))
    gripper.move(REST_OPENING, SPEED)


def recorded(bag: Path) -> Grasp:
    """Read what a finger did from its bag."""
    opened = open_bag(bag)

    def signal(name: str) -> Signal:
        samples = opened.messages(f"/{bag.name}/{name}", SAMPLE_TYPE)
        numbers = np.array([sample.number for sample in samples])
        return Signal(numbers * SAMPLE_TIME, np.array([sample.value for sample in samples]))

    return Grasp(read(bag), signal("contact_force"), signal("push"))


def figures(grasps: list[Grasp]) -> dict[str, float]:
    """Return what the bead felt, and for how long it was not held."""
    forces = [grasp.force for grasp in grasps]
    held = [f.value[(f.time > HELD_FROM) & (f.time < CARRIED_UNTIL)] for f in forces]
    lost = max(float(np.mean(force <= 0.0)) for force in held)
    return {
        "largest force [mN]": 1e3 * max(float(f.value.max()) for f in forces),
        "least force while held [mN]": 1e3 * min(float(f.min()) for f in held),
        "largest force while held [mN]": 1e3 * max(float(f.max()) for f in held),
        "dropped for [ms]": 1e3 * lost * (CARRIED_UNTIL - HELD_FROM),
    }


def draw(runs: dict[str, list[Grasp]], path: Path) -> Path:
    """Draw force, opening and temperature of all ways over time."""
    figure, axes = plt.subplots(
        3, len(runs), figsize=(4.2 * len(runs), 7.0), sharex=True, squeeze=False
    )
    for column, (name, grasps) in zip(axes.T, runs.items()):
        for side, grasp in zip(SIDES, grasps):
            finger = grasp.finger
            column[0].plot(grasp.force.time, 1e3 * grasp.force.value, lw=0.8, label=f"{side}, true")
            if grasp.push.time.size:
                told = 1e3 * grasp.push.value
                column[0].plot(grasp.push.time, told, "--", lw=0.8, label=f"{side}, as told")
            column[2].plot(finger.time, finger.temperature, lw=0.8)
        left, right = (grasp.finger for grasp in grasps)
        opening = (
            REST_OPENING - left.deflection - np.interp(left.time, right.time, right.deflection)
        )
        column[1].plot(left.time, 1e6 * opening, lw=0.8)
        column[1].axhline(1e6 * BEAD, color="k", ls=":", lw=0.8)
        column[0].axhline(1e3 * FORCE, color="k", ls=":", lw=0.8)
        column[0].set_title(WAYS[name].title)
        column[0].legend(fontsize=7)
        column[2].set_xlabel("time of the finger [s]")
    for axis, label in zip(axes[:, 0], ("force [mN]", "opening [µm]", "temperature [°C]")):
        axis.set_ylabel(label)
    figure.tight_layout()
    return save(figure, path)


def work(
    arguments: argparse.Namespace, out: Path, console: Console
) -> tuple[dict[str, Any], list[Section]]:
    """Pick, hold, carry and place in every way that is asked for, and draw what came of it."""
    runs = {}
    with alone("", *(f"/{side}" for side in SIDES)):
        for name in arguments.ways:
            with console.status(f"{WAYS[name].title}: {CARRIED_UNTIL:g} s of two fingers"):
                try:
                    bags = run(WAYS[name], out / name)
                except ClientError as error:
                    raise RunFailed(str(error)) from None
                runs[name] = [recorded(bag) for bag in bags.values()]
    found = {name: figures(grasps) for name, grasps in runs.items()}
    picture = draw(runs, out / "grasp.png")
    rows = [
        [key, *(f"{found[name][key]:.3f}" for name in runs)] for key in next(iter(found.values()))
    ]
    section = Section(
        "A bead of 50 µm, picked, held while it gets 10 °C warmer, carried, placed", TEXT,
        [(picture, "Force of the bead on the tips, opening, temperature.")],
        ["figure", *(WAYS[name].title for name in runs)], rows,
    )  # fmt: skip
    return found, [section]


def main() -> int:
    """Run the command line and return its exit code."""
    parser = study.parser("piezo_sim.experiment.on_nodes.grasp", __doc__)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    return study.run(parser.parse_args(), "A bead between two fingers", work)


if __name__ == "__main__":
    sys.exit(main())
