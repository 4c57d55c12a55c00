# SPDX-License-Identifier: Apache-2.0
"""One finger's nodes as processes, links between them that can be disturbed, and a watcher of what must hold."""

from __future__ import annotations

import contextlib
import math
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import rclpy
from fault_plant import LED
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.logging import LoggingSeverity
from rclpy.qos import QoSProfile, qos_profile_sensor_data

from piezo_control.nodes.qos import LATCHED, SAMPLE, SETPOINT
from piezo_control.safety import VoltageParameters
from piezo_gripper_msgs.msg import FingerState, RecorderState, Sample
from piezo_sim.experiment.cases import params_folder
from piezo_sim.experiment.on_nodes.processes import NodeProcesses

NODES = ("feedforward", "feedback", "cantilever")
SENDERS = {"deflection": "cantilever", "command": "feedback", "voltage": "feedforward"}
STANDS = VoltageParameters()
CATCHING_UP = 3.0  # s after which one that stood still has done what was due
SLEW = 1e3  # V/s of the amplifier, running free, where 40 V/ms is no limit at 5 ms a sample


class Network:
    """A network namespace of its own for one node, at the end of a link that can be cut."""

    def __init__(self) -> None:
        self.name = f"faults{os.getpid()}"
        self.link = f"faults{os.getpid() % 10**8}"

    def __enter__(self) -> Network:
        subnet = f"10.{200 + os.getpid() % 50}.{os.getpid() // 50 % 250}"
        inside = f"ip netns exec {self.name} ip"
        for command in (
            f"ip netns add {self.name}",
            f"ip link add {self.link} type veth peer name inside netns {self.name}",
            f"ip address add {subnet}.1/24 dev {self.link}",
            f"ip link set {self.link} up",
            f"{inside} address add {subnet}.2/24 dev inside",
            f"{inside} link set inside up",
            f"{inside} link set lo up",
        ):
            try:
                subprocess.run(command.split(), check=True, capture_output=True)
            except subprocess.CalledProcessError:
                self.__exit__()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        # The link first: the kernel takes its time with what is left in a namespace, and its name stays taken.
        for command in (f"ip link delete {self.link}", f"ip netns delete {self.name}"):
            subprocess.run(command.split(), capture_output=True)

    def set(self, state: str) -> None:
        """Put the link 'up' or 'down'."""
        subprocess.run(["ip", "link", "set", self.link, state], check=True, capture_output=True)


def may_make_networks() -> bool:
    """Say whether this process has what network namespaces ask for: root's rights and `ip`."""
    try:
        with Network():
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


class Processes(NodeProcesses):
    """The nodes of a finger, with a witness at the plant, and `feedback` in another network if there is one."""

    network: Network | None = None

    def program(self, name: str) -> list[str]:
        if name == "cantilever":
            return [sys.executable, str(Path(__file__).with_name("fault_plant.py"))]
        prefix = []
        if name == "feedback" and self.network:
            # With shared memory of its own too, past which two machines cannot talk either.
            apart = 'mount -t tmpfs none /dev/shm && exec "$0" "$@"'
            prefix = ["ip", "netns", "exec", self.network.name, "sh", "-c", apart]
        return [*prefix, *super().program(name)]


class Link:
    """Carries the samples of a topic, and loses or delays some of them; what is delayed is overtaken."""

    def __init__(self, bench: Bench, topic: str, qos: QoSProfile) -> None:
        self.topic = topic
        self.lost = self.delayed = self.longest = 0.0
        self.draw = bench.draw
        self.waiting: list[tuple[float, Sample]] = []
        self.publisher = bench.node.create_publisher(Sample, topic, qos)
        bench.node.create_subscription(Sample, f"{topic}_sent", self._carry, SAMPLE)
        bench.node.create_timer(0.005, self._release)

    def disturb(self, lost: float, delayed: float, longest: float) -> None:
        """Lose and delay these shares of the samples, by up to `longest` s."""
        self.lost, self.delayed, self.longest = lost, delayed, longest

    def _carry(self, sample: Sample) -> None:
        fate = self.draw.random()
        if fate < self.delayed:
            self.waiting.append((time.monotonic() + self.draw.uniform(0.0, self.longest), sample))
        elif fate >= self.delayed + self.lost:
            self.publisher.publish(sample)

    def _release(self) -> None:
        now = time.monotonic()
        due = [sample for instant, sample in self.waiting if instant <= now]
        self.waiting = [item for item in self.waiting if item[0] > now]
        self.draw.shuffle(due)
        for sample in due:
            self.publisher.publish(sample)


@dataclass
class Bench:
    """The finger's processes, a node beside them, and what was seen."""

    lockstep: bool
    processes: Processes
    draw: random.Random
    linked: str = ""
    """Topic that goes through a link; empty: none."""
    misfit: bool = False
    """The link offers a quality of service that its reader cannot hear."""
    ended: set[str] = field(default_factory=set)
    """Nodes that were told to end, or to be inactive."""
    foreign: set[str] = field(default_factory=set)
    """Topics on which somebody else published."""
    missing: list[tuple[str, ...]] = field(default_factory=list)
    """Words, of each entry of which the logs must have one; kept while one kind of event alone was at work."""
    violations: list[str] = field(default_factory=list)
    seen: list[tuple[float, int, float]] = field(default_factory=list)
    """Deflections as published: s on the steady clock, number, m."""
    recorded: list[tuple[float, int]] = field(default_factory=list)
    """How many of them the recorder had written, and when (s) it said so."""
    halts: dict[str, float] = field(default_factory=dict)
    """Node to the time (s) at which it was made to stand still last."""
    ends: list[tuple[str, float]] = field(default_factory=list)
    """Nodes that were ended, and when (s): killed in their sleep, as soon as they slept."""
    samples: int = 0
    number: int = -1
    deflection: float = 0.0
    finger: FingerState = field(default_factory=FingerState)

    def __post_init__(self) -> None:
        self.node = rclpy.create_node("watcher")
        self.node.get_logger().set_level(LoggingSeverity.ERROR)
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)
        self.link = None
        if self.linked:
            self.link = Link(self, self.linked, qos_profile_sensor_data if self.misfit else SAMPLE)
        self.node.create_subscription(FingerState, "state", self._on_state, LATCHED)
        self.node.create_subscription(Sample, self.sent("deflection"), self._on_deflection, SAMPLE)
        self.node.create_subscription(RecorderState, "recorder_state", self._on_recorded, LATCHED)
        self.node.create_subscription(Sample, self.sent("voltage"), self._on_voltage, SAMPLE)
        self.reference = self.node.create_publisher(Sample, "reference", SETPOINT)

    def sent(self, topic: str) -> str:
        """Return the name under which a topic leaves its sender."""
        return f"{topic}_sent" if topic == self.linked else topic

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

    def end(self, name: str, number: int) -> None:
        """Send a signal that ends a process."""
        now = time.monotonic()
        slept = self.halts.get(name, -math.inf)
        self.ends.append((name, slept if now - slept < CATCHING_UP else now))
        self.processes.running[name].send_signal(number)

    def broken(self, text: str) -> None:
        if text not in self.violations:
            self.violations.append(text)

    def call(self, kind, service: str, request):
        """Call a service of a node that may be gone; return its answer, or None."""
        client = self.node.create_client(kind, service)
        answer = None
        if self.wait(1.0, client.service_is_ready):
            future = client.call_async(request)
            if self.wait(1.0, future.done):
                answer = future.result()
        self.node.destroy_client(client)
        return answer

    def _on_state(self, state: FingerState) -> None:
        self.finger = state
        if not STANDS.voltage_low <= state.voltage <= STANDS.voltage_high:
            self.broken(f"the finger had {state.voltage} V")
        if state.phase == FingerState.FAULT and not (
            state.text and state.times and state.since.sec
        ):
            self.broken(f"a fault without name, time or count: {state}")

    def _on_deflection(self, sample: Sample) -> None:
        if "deflection" in self.foreign:
            return
        self.samples += 1
        self.seen.append((time.monotonic(), sample.number, sample.value))
        self.deflection = sample.value
        if self.lockstep:
            if self.number >= 0 and sample.number not in (0, self.number, self.number + 1):
                self.broken(f"deflection {sample.number} after {self.number}")
            self.number = sample.number

    def _on_recorded(self, state: RecorderState) -> None:
        self.recorded.append((time.monotonic(), sum(state.recorded)))

    def _on_voltage(self, sample: Sample) -> None:
        if "voltage" not in self.foreign and not (
            STANDS.voltage_low <= sample.value <= STANDS.voltage_high
        ):
            self.broken(f"feedforward published {sample.value} V")


@contextlib.contextmanager
def finger(
    lockstep: bool,
    linked: str,
    misfit: bool,
    is_recorded: bool,
    network: Network | None,
    draw: random.Random,
    folder: Path,
) -> Iterator[Bench]:
    """Start the nodes of a finger in lock-step with a controller, or running free without one.

    Where it `is_recorded` a recorder writes its deflection into `folder`/bag.
    """
    arguments = {name: ["--ros-args"] for name in NODES}
    if lockstep:
        arguments["feedback"] += ["--params-file", str(params_folder() / "feedback_robust.yaml")]
    else:
        for words in arguments.values():
            words += ["-p", "mode:=free_running", "-p", "sample_time:=0.005"]
        arguments["feedforward"] += ["-p", f"slew_limit:={LED}"]
        arguments["cantilever"] += ["-p", f"amplifier.slew_limit:={SLEW}", "-p", f"ramp:={LED}"]
    if linked:
        arguments[SENDERS[linked]] += ["-r", f"{linked}:={linked}_sent"]
    if is_recorded:
        arguments["recorder"] = [
            "--ros-args",
            "-p",
            f"bag:={folder / 'bag'}",
            "-p",
            "topics:=[deflection]",
        ]
    # Another network is reached beyond this machine's own loopback.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET" if network else "LOCALHOST"
    rclpy.init()
    try:
        processes = Processes(arguments, folder)
        processes.network = network
        with processes:
            bench = Bench(lockstep, processes, draw, linked, misfit)
            try:
                yield bench
            finally:
                bench.close()
    finally:
        rclpy.shutdown()
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
