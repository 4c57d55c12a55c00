# SPDX-License-Identifier: Apache-2.0
"""A campaign of faults on live nodes: random schedules, and what has to hold after every sample.

Each schedule starts the nodes of one finger as processes, lets things go wrong in an order and at times that
its seed decides, and watches. `python test/faults.py` runs many and prints the seeds that failed.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.parameter import Parameter
from rich.progress import Progress

from piezo_control.nodes.qos import LATCHED, SAMPLE, SETPOINT
from piezo_control.safety import VoltageParameters
from piezo_gripper_msgs.msg import FingerState, Sample
from piezo_sim.experiment.cases import params_folder
from piezo_sim.experiment.on_nodes.processes import NodeProcesses

NODES = ("feedforward", "feedback", "cantilever")
STANDS = VoltageParameters()
FARTHEST = (
    66e-6  # m: where a step from one end of the reach, 22 µm, to the other overshoots to, undamped
)
START = 30.0  # s that the loop may take to run on a busy machine
OUTCOME = (
    20.0  # s until it tracks again or a fault is latched and named; reply_timeout is 2 s of them
)
NONSENSE = (math.nan, math.inf, -1e300, 1e6, 20.0, 5e-324)


@dataclass
class Bench:
    """One finger's processes, a node beside them, and what was seen."""

    lockstep: bool
    processes: NodeProcesses
    draw: random.Random
    killed: set[str] = field(default_factory=set)
    foreign: set[str] = field(default_factory=set)
    violations: list[str] = field(default_factory=list)
    samples: int = 0
    number: int = -1
    finger: FingerState = field(default_factory=FingerState)

    def __post_init__(self) -> None:
        self.node = rclpy.create_node("watcher")
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)
        self.node.create_subscription(FingerState, "state", self._on_state, LATCHED)
        self.node.create_subscription(Sample, "deflection", self._on_deflection, SAMPLE)
        self.node.create_subscription(Sample, "voltage", self._on_voltage, SAMPLE)
        self.reference = self.node.create_publisher(Sample, "reference", SETPOINT)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()

    def wait(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Serve events until `done()` or for so many seconds; say whether it was done."""
        end = time.monotonic() + seconds
        while not done():
            if time.monotonic() > end:
                return False
            self.executor.spin_once(timeout_sec=0.02)
        return True

    def broken(self, text: str) -> None:
        if text not in self.violations:
            self.violations.append(text)

    def _on_state(self, state: FingerState) -> None:
        self.finger = state
        if not STANDS.voltage_low <= state.voltage <= STANDS.voltage_high:
            self.broken(f"the finger had {state.voltage} V")
        if state.phase == FingerState.FAULT and not state.text:
            self.broken("a fault without a name")

    def _on_deflection(self, sample: Sample) -> None:
        if "deflection" in self.foreign:
            return
        self.samples += 1
        if not abs(sample.value) <= FARTHEST and not self.foreign:
            self.broken(f"the tip was at {sample.value} m")
        if self.lockstep:
            if self.number >= 0 and sample.number not in (0, self.number, self.number + 1):
                self.broken(f"deflection {sample.number} after {self.number}")
            self.number = sample.number

    def _on_voltage(self, sample: Sample) -> None:
        if "voltage" not in self.foreign and not (
            STANDS.voltage_low <= sample.value <= STANDS.voltage_high
        ):
            self.broken(f"feedforward published {sample.value} V")

    def call(self, kind, service: str, request) -> None:
        """Call a service of a node that may be gone; nobody waits for the answer."""
        client = self.node.create_client(kind, service)
        if self.wait(1.0, client.service_is_ready):
            client.call_async(request)
            self.wait(0.2)


def halt(bench: Bench) -> None:
    process = bench.processes.running[bench.draw.choice(NODES)]
    process.send_signal(signal.SIGSTOP)
    bench.wait(bench.draw.choice((0.02, 0.3, 1.0)))
    process.send_signal(signal.SIGCONT)


def end(bench: Bench) -> None:
    name = bench.draw.choice(NODES)
    number = bench.draw.choice(
        (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGKILL)
    )
    bench.killed.add(name)
    bench.processes.running[name].send_signal(number)


def transition(bench: Bench) -> None:
    """Any transition of any node, most of them impossible; at times there and back."""
    name = bench.draw.choice(NODES)
    numbers = bench.draw.choice(([bench.draw.choice((1, 2, 3, 4, 7, 99))], [4, 3]))
    for number in numbers:
        bench.killed |= {name} if number in (4, 7) else set()
        request = ChangeState.Request(transition=Transition(id=number))
        bench.call(ChangeState, f"{name}/change_state", request)


def parameter(bench: Bench) -> None:
    name, value = bench.draw.choice(
        (
            ("use_sim_time", True), ("voltage_high", 1e308), ("slew_limit", math.nan), ("ramp", 1e7),
            ("sample_time", 0.01), ("d", 1e6), ("a", [math.inf]), ("controller_file", "/nowhere"),
            ("mode", "free_running"), ("hysteresis.weights", [-1.0]), ("samples", -1), ("no", "such"),
        )
    )  # fmt: skip
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    bench.call(SetParameters, f"{bench.draw.choice(NODES)}/set_parameters", request)


def intrude(bench: Bench) -> None:
    """A second publisher of a topic of the loop, with nonsense, stray numbers, or quick swings."""
    topic = bench.draw.choice(("voltage", "command", "deflection", "reference"))
    bench.foreign.add(topic)
    publisher = bench.node.create_publisher(Sample, topic, SAMPLE)
    for k in range(bench.draw.choice((1, 30))):
        value = bench.draw.choice((*NONSENSE, 39.0 * (-1) ** k, 2e-5 * (-1) ** k))
        number = bench.draw.choice((0, k, bench.number + 1, 2**64 - 1))
        publisher.publish(Sample(number=max(0, number), value=value))
        bench.wait(0.005)
    bench.node.destroy_publisher(publisher)


def refer(bench: Bench) -> None:
    for _ in range(20):
        value = bench.draw.choice((*NONSENSE, 1.7e308, -2e-5, 2e-5, 1e-5))
        bench.reference.publish(Sample(value=value))
        bench.wait(0.01)


def load(bench: Bench) -> None:
    """Both cores busy for a while."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    bench.wait(1.0)
    for process in busy:
        process.kill()
        process.wait()


EVENTS = (halt, end, transition, parameter, intrude, refer, load)


@contextlib.contextmanager
def finger(seed: int, folder: Path) -> Iterator[Bench]:
    """Start the nodes of a finger as the seed has it."""
    draw = random.Random(seed)
    lockstep = draw.random() < 0.6
    arguments = {name: ["--ros-args"] for name in NODES}
    if lockstep:
        arguments["feedback"] += ["--params-file", str(params_folder() / "feedback_robust.yaml")]
    else:
        for words in arguments.values():
            words += ["-p", "mode:=free_running", "-p", "sample_time:=0.005"]
    rclpy.init()
    try:
        with NodeProcesses(arguments, folder) as processes:
            bench = Bench(lockstep, processes, draw)
            try:
                yield bench
            finally:
                bench.close()
    finally:
        rclpy.shutdown()


def run_schedule(seed: int, folder: Path) -> list[str]:
    """Run one schedule; return what was violated, an empty list if nothing."""
    with finger(seed, folder) as bench:
        moving = 200 if bench.lockstep else 20
        if not bench.wait(START, lambda: bench.samples > moving):
            return ["the loop did not begin to run"]
        bench.reference.publish(Sample(value=1e-5))
        for _ in range(bench.draw.randint(1, 3)):
            bench.wait(bench.draw.uniform(0.0, 0.3))
            bench.draw.choice(EVENTS)(bench)
        for name, process in bench.processes.running.items():
            if process.poll() is not None and name not in bench.killed:
                bench.broken(f"{name} ended ({process.returncode})")
        before = bench.finger.samples

        def is_decided() -> bool:
            if "cantilever" in bench.killed:
                return True
            is_running = bench.finger.phase == FingerState.RUNNING
            return is_running and bench.finger.samples > before + moving or bench.finger.phase in (
                FingerState.FAULT, FingerState.IDLE, FingerState.WAITING,
            )  # fmt: skip

        if not bench.wait(OUTCOME, is_decided):
            bench.broken(f"undecided: phase {bench.finger.phase}, '{bench.finger.text}'")
        violations = bench.violations
        processes = dict(bench.processes.running)
    violations += [f"{n} is left behind" for n, p in processes.items() if p.poll() is None]
    for path in folder.glob("*.log"):
        words = path.read_text(errors="replace")
        if "Traceback" in words:
            violations.append(f"{path.stem}: {words.strip().splitlines()[-1]}")
    return violations


def main() -> int:
    """Run the campaign of the command line; return 0 when nothing was violated."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--schedules", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first schedule")
    arguments = parser.parse_args()
    failed = {}
    with Progress() as progress, tempfile.TemporaryDirectory() as folder:
        seeds = range(arguments.seed, arguments.seed + arguments.schedules)
        for seed in progress.track(seeds, description="schedules"):
            if violations := run_schedule(seed, Path(folder) / str(seed)):
                failed[seed] = violations
                progress.console.print(f"seed {seed}: {'; '.join(violations)}", soft_wrap=True)
    print(f"{arguments.schedules} schedules, {len(failed)} with violations {list(failed) or ''}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
