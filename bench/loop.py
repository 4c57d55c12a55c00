# SPDX-License-Identifier: Apache-2.0
"""Speed of the loop over topics: against the default executor, against a bare ring, free-running.

Each function returns rows ``{"name", "value", "unit", "reference", "ratio"}``, measured in turns with
their reference so that both see the same machine.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from engine import row
from rcl_interfaces.srv import GetParameters
from rclpy.experimental.events_executor import EventsExecutor

from piezo_control.nodes.qos import LATCHED, SAMPLE
from piezo_gripper_msgs.msg import FingerState, RecorderState, Sample
from piezo_sim.experiment.cases import params_folder
from piezo_sim.experiment.on_nodes.processes import NodeProcesses

HERE = Path(__file__).resolve().parent
ROUNDS = 3
SECONDS = 3.0  # of one measurement
WARM_UP = 0.5  # s at full rate before it
LOOP = ("temperature", "feedforward", "feedback", "cantilever")
RATES_HZ = (20, 50, 100, 200, 500, 1000, 2000, 5000)
STEADY = 0.999  # share of the periods
TOLERANCE = 0.1  # of the sample time


class Observer:
    """The bench's own node: sees the state of the fingers and calls services."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("bench")
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()

    def wait(self, done: Callable[[], bool], timeout: float = 30.0) -> None:
        end = time.monotonic() + timeout
        while not done():
            if time.monotonic() > end:
                raise TimeoutError(f"nothing after {timeout:g} s")
            self.executor.spin_once(timeout_sec=0.02)

    def latest(self, kind: type, topic: str) -> list[Any]:
        """Return a list that always holds the newest message of a latched topic, once one came."""
        newest: list[Any] = []

        def take(message: Any) -> None:
            newest[:] = [message]

        self.node.create_subscription(kind, topic, take, LATCHED)
        return newest

    def rate(self, finger: str, seconds: float = SECONDS) -> float:
        """Return the samples per second that finger `finger` takes now."""
        state = self.latest(FingerState, f"{finger}/state")
        self.wait(lambda: state and state[0].phase == FingerState.RUNNING)
        for pause in (WARM_UP, seconds):
            begin, first = time.monotonic(), state[0].samples
            self.wait(lambda end=begin + pause: time.monotonic() > end)
            self.wait(lambda n=state[0].samples: state[0].samples > n)
            now, last = time.monotonic(), state[0].samples
        return (last - first) / (now - begin)


@contextmanager
def observer() -> Iterator[Observer]:
    rclpy.init()
    watching = Observer()
    try:
        yield watching
    finally:
        watching.close()
        rclpy.shutdown()


def arguments(name: str, finger: str, **parameters: Any) -> list[str]:
    """Return the command-line arguments of node `name` in namespace `finger`."""
    words = ["--ros-args", "-r", f"__ns:=/{finger}"]
    if name in ("feedback", "finger"):
        words += ["--params-file", str(params_folder() / "feedback_paper.yaml")]
    for key, value in parameters.items():
        words += ["-p", f"{key}:={value}"]
    return words


def finger(name: str, log: Path, **parameters: Any) -> NodeProcesses:
    """Return the four processes of a finger in lock-step."""
    return NodeProcesses({node: arguments(node, name, **parameters) for node in LOOP}, log)


@contextmanager
def default_executor(name: str) -> Iterator[None]:
    """Run the same nodes as :func:`finger` by `rclpy.init` and `rclpy.spin` as they are."""
    script = str(HERE / "default_executor.py")
    processes = [
        subprocess.Popen([sys.executable, script, node, *arguments(node, name)]) for node in LOOP
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def ring(hops: int, seconds: float) -> float:
    """Return the turns per second of a bare ring of `hops` processes (see ring.py)."""
    command = [sys.executable, str(HERE / "ring.py"), str(hops)]
    others = [subprocess.Popen([*command, str(i), str(seconds)]) for i in range(1, hops)]
    try:
        first = subprocess.run(
            [*command, "0", str(seconds)], capture_output=True, text=True, check=True, timeout=60
        )
        return float(first.stdout)
    finally:
        for process in others:
            process.kill()
            process.wait()


def lockstep(log: Path) -> list[dict[str, Any]]:
    """The loop's rate against the default executor, a bare ring, and the nodes in one process."""
    ours, default, bare, composed = [], [], [], []
    for _ in range(ROUNDS):
        with observer() as watching, finger("finger", log):
            ours.append(watching.rate("finger"))
        with observer() as watching, default_executor("finger"):
            default.append(watching.rate("finger"))
        bare.append(ring(3, SECONDS))
        one = {"finger": arguments("finger", "finger")}
        with observer() as watching, NodeProcesses(one, log):
            composed.append(watching.rate("finger"))
    value = statistics.median(ours)
    return [
        row("loop over topics, against rclpy's default executor", value, "samples/s",
            statistics.median(default)),
        row("loop over topics, against a bare ring of three hops", value, "samples/s",
            statistics.median(bare)),
        row("loop in one process, against separate ones", statistics.median(composed),
            "samples/s", value),
    ]  # fmt: skip


def responsiveness(log: Path) -> list[dict[str, Any]]:
    """The slowest of many parameter services while the loop runs at full rate; reference 100 ms."""
    slowest = 0.0
    with observer() as watching, finger("finger", log):
        watching.rate("finger", 0.5)
        for name in LOOP:
            client = watching.node.create_client(GetParameters, f"finger/{name}/get_parameters")
            watching.wait(client.service_is_ready)
            for _ in range(50):
                begin = time.monotonic()
                answer = client.call_async(GetParameters.Request(names=["mode"]))
                watching.wait(answer.done)
                slowest = max(slowest, time.monotonic() - begin)
    return [row("slowest parameter service at full rate", slowest, "s", 0.1)]


def recording(log: Path, folder: Path) -> list[dict[str, Any]]:
    """The rate of two fingers while each is recorded, against the same unrecorded.

    Raises RuntimeError if a recorder lost a sample.
    """
    sides = ("left", "right")
    rates: dict[bool, list[float]] = {False: [], True: []}
    for turn in range(ROUNDS):
        for recorded in rates:
            with ExitStack() as stack:
                watching = stack.enter_context(observer())
                states = []
                for side in sides:
                    if recorded:
                        bag = arguments("recorder", side, bag=folder / f"{side}{turn}")
                        stack.enter_context(NodeProcesses({"recorder": bag}, log / side))
                        states.append(watching.latest(RecorderState, f"{side}/recorder_state"))
                    stack.enter_context(finger(side, log / side, subscribers=1 + recorded))
                rates[recorded].append(watching.rate(sides[0]))
                if any(sum(state.missing) for (state,) in states):
                    raise RuntimeError(f"a recorder lost samples: {states}")
    value, reference = statistics.median(rates[True]), statistics.median(rates[False])
    return [row("loop of two fingers, recorded, against unrecorded", value, "samples/s", reference)]


def free_running(log: Path) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """The highest steady rate of separate and of composed nodes, and the periods at that rate.

    Steady means that 99.9 % of the periods are within 10 % of the sample time. The reference of a row is
    the finger's resonance, 666.6 Hz (paper, eq. 5).
    """
    rows, histograms = [], {}
    for label, executables in (("separate processes", LOOP), ("one process", ("finger",))):
        best = 0.0
        for rate in RATES_HZ:
            periods = free_periods(executables, 1.0 / rate, log)
            share = float(np.mean(np.abs(periods * rate - 1.0) <= TOLERANCE))
            print(
                f"free-running, {label}, {rate} Hz: {100 * share:.2f} % of the periods within 10 %"
            )
            if share < STEADY:
                break
            best, histograms[label] = float(rate), periods
        rows.append(row(f"free-running, {label}: highest steady rate", best, "Hz", 666.6))
    return rows, histograms


def free_periods(executables: tuple[str, ...], sample_time: float, log: Path) -> np.ndarray:
    """Return the periods (s) between the deflections of a free-running finger, by its own stamps."""
    commands = {}
    for name in executables:
        commands[name] = ["--ros-args", "-r", "__ns:=/free", "-p", "mode:=free_running"]
        if name != "temperature":
            commands[name] += ["-p", f"sample_time:={sample_time}"]
    stamps: list[float] = []

    def take(sample: Sample) -> None:
        stamps.append(sample.header.stamp.sec + sample.header.stamp.nanosec * 1e-9)

    with observer() as watching, NodeProcesses(commands, log):
        watching.node.create_subscription(Sample, "free/deflection", take, SAMPLE)
        state = watching.latest(FingerState, "free/state")
        watching.wait(lambda: state and state[0].phase == FingerState.RUNNING)
        stamps.clear()
        watching.wait(lambda: len(stamps) * sample_time > SECONDS, timeout=10 * SECONDS)
    return np.diff(stamps)


def start_up(folder: Path) -> list[dict[str, Any]]:
    """Seconds from `experiment step` to the first sample, against the 3 s that it may take."""
    begin = time.time()
    experiment = subprocess.Popen(
        ["experiment", "step", "--out", str(folder / "start"), "--namespace", "start"],
        stdout=subprocess.DEVNULL,
    )
    try:
        with observer() as watching:
            state = watching.latest(FingerState, "start/state")
            watching.wait(lambda: state and state[0].samples > 0)
            seconds = time.time() - begin
    finally:
        experiment.terminate()
        experiment.wait()
    return [row("from `experiment step` to the first sample", seconds, "s", 3.0)]
