# SPDX-License-Identifier: Apache-2.0
"""The certified step in real time: the servo at 10 kHz against a finger in another process, recorded.

Starts `udp_finger`, `servo` and `recorder`, sends one step of 20 µm and back, and reads the bag: settling,
samples that are missing, and how late the loop began its periods. The tables stand beside what the certificate
says of the same controller.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import rclpy
from rich.console import Console

from piezo_control.metrics import step_metrics
from piezo_control.nodes import spin
from piezo_control.profile import Profile
from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import BLOCK_TYPE, Recording, read
from piezo_control.report.page import Section
from piezo_control.sequence import SAMPLE_TIME
from piezo_gripper_msgs.msg import FingerState
from piezo_sim.experiment import study
from piezo_sim.experiment.cases import RunFailed
from piezo_sim.experiment.on_nodes.conductor import Conductor, alone
from piezo_sim.experiment.on_nodes.processes import NodeProcesses
from piezo_sim.experiment.plots import save

STEP = 20e-6  # m
LEAD = 0.2  # s from the order to the step
HELD = 0.5  # s
COMPILING = 180.0  # s that the first start may take

TEXT = (
    "Finger and servo are two processes that exchange one datagram each way per sample; the servo has its own "
    "real-time thread, the recorder takes down every sample. A period is late by the time from its edge on "
    "the clock to when the loop began it."
)


def run(out: Path) -> tuple[Path, dict[str, Any]]:
    """Run the step, recorded into `out`; return the bag and what the finger saw."""
    log = out / "log"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # The servo writes at the next edge, which is the one sample of delay that the controller is made for.
    undelayed = out / "finger.yaml"
    undelayed.write_text("/**/cantilever:\n  ros__parameters: {sensor: {delay_samples: 0}}\n")
    seen, bag = out / "seen.json", out / "bag"
    finger = ["--port", str(port), "--cantilever", str(undelayed), "--report", str(seen)]
    servo = [
        "driver:=udp",
        f"driver_options:=127.0.0.1:{port}",
        "write:=next_edge",
        "delay_samples:=0",
    ]
    commands = {
        "recorder": ["--ros-args", "-p", f"bag:={bag}"],
        "servo": ["--ros-args", *(word for value in servo for word in ("-p", value))],
    }
    with NodeProcesses({"udp_finger": [*finger, "--priority", "70"]}, log) as far_end:
        spin.init()
        conductor = Conductor([], "", far_end.check)
        try:
            conductor.wait(
                lambda: "answers" in (log / "udp_finger.log").read_text(), COMPILING, "the finger"
            )
            with NodeProcesses(commands, log) as nodes:
                step_and_back(conductor, nodes)
        finally:
            conductor.close()
            rclpy.shutdown()
    return bag, json.loads(seen.read_text())


def step_and_back(conductor: Conductor, nodes: NodeProcesses) -> None:
    """Let the servo follow a step and wait until that is recorded."""

    def is_running() -> bool:
        nodes.check()
        recorded = dict(zip(conductor.recorder.topics, conductor.recorder.recorded))
        return conductor.finger.phase == FingerState.RUNNING and recorded.get("samples", 0) > 0

    conductor.wait(is_running, COMPILING, "the servo and the recorder")
    begin = conductor.finger.samples * SAMPLE_TIME + LEAD
    instants = [begin, begin + HELD]
    conductor.publish("reference", Profile([0.0, *instants], [0.0, STEP, 0.0]))
    end = round((instants[-1] + HELD) / SAMPLE_TIME)

    def is_over() -> bool:
        nodes.check()
        if conductor.finger.phase != FingerState.RUNNING:
            raise RunFailed(f"servo: {conductor.finger.text}")
        return conductor.finger.samples > end

    conductor.wait(is_over, 60.0, "the end of the step")
    written = time.monotonic() + 0.2  # a block or two on their way
    conductor.wait(lambda: time.monotonic() > written, 1.0, "the last blocks")


def figures(bag: Path, seen: dict[str, Any]) -> tuple[dict[str, float], Recording, np.ndarray]:
    """Return the figures of the run, its recording and how late (s) each period began."""
    recording = read(bag)
    blocks = open_bag(bag).messages("/samples", BLOCK_TYPE)
    late = np.concatenate([block.late for block in blocks])
    begin = int(np.flatnonzero(recording.reference == STEP)[0])
    answered = np.isfinite(recording.deflection)
    part = np.flatnonzero(answered & (recording.reference == STEP))
    step = step_metrics(
        recording.time[part] - recording.time[begin], recording.deflection[part], STEP
    )
    return (
        {
            "settling into 5 % [ms]": 1e3 * float(step.settling_5_reference_s),
            "overshoot [%]": 100.0 * float(step.overshoot),
            "samples recorded": float(recording.number.size),
            "numbers missing in the bag [%]": 100.0
            * (1.0 - recording.number.size / (recording.number[-1] - recording.number[0] + 1)),
            "readings not in time [%]": 100.0 * (1.0 - float(np.mean(answered))),
            "periods begun within 10 µs [%]": 100.0 * float(np.mean(late <= 1e-5)),
            "late, 99.9 % of the periods [µs]": 1e6 * float(np.quantile(late, 0.999)),
            "largest step the finger saw [V]": seen["largest_step"],
        },
        recording,
        late,
    )


def draw(recording: Recording, late: np.ndarray, path: Path) -> Path:
    """Draw the step and the histogram of the lateness."""
    figure, (step, jitter) = plt.subplots(1, 2, figsize=(9, 3.4))
    begin = int(np.flatnonzero(recording.reference == STEP)[0])
    part = slice(begin - 20, begin + 180)
    time_ms = 1e3 * (recording.time[part] - recording.time[begin])
    step.plot(time_ms, 1e6 * recording.reference[part], "k:", label="reference")
    step.plot(time_ms, 1e6 * recording.deflection[part], label="deflection")
    step.set(xlabel="time [ms]", ylabel="deflection [µm]")
    step.legend()
    jitter.hist(np.clip(1e6 * late, 0.0, 100.0), 100, histtype="step", log=True)
    jitter.set(xlabel="late by [µs], 100 and more in the last bin", ylabel="periods")
    figure.tight_layout()
    return save(figure, path)


def work(
    arguments: argparse.Namespace, out: Path, console: Console
) -> tuple[dict[str, Any], list[Section]]:
    """Run the step and draw what came of it."""
    words = "a step of 20 µm at 10 kHz; at first the loops are compiled"
    with alone(""), console.status(words):
        bag, seen = run(out)
    found, recording, late = figures(bag, seen)
    picture = draw(recording, late, out / "servo.png")
    rows = [[name, f"{value:.4g}"] for name, value in found.items()]
    section = Section(
        "10 kHz in real time, over UDP", TEXT, [(picture, "Step of 20 µm; lateness of the periods.")],
        ["figure", "value"], rows,
    )  # fmt: skip
    return found, [section]


def main() -> int:
    """Run the command line and return its exit code."""
    parser = study.parser("piezo_sim.experiment.on_nodes.servo", __doc__)
    return study.run(parser.parse_args(), "The servo", work)


if __name__ == "__main__":
    sys.exit(main())
