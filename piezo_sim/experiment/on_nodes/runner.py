# SPDX-License-Identifier: Apache-2.0
"""Runs cases over topics: separate node processes, one bag per case."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import rclpy
from rich.progress import Progress

from piezo_control.nodes import spin
from piezo_control.start import stop_at_signals
from piezo_gripper_msgs.msg import FingerState
from piezo_sim.experiment.cases import NODES, Case, CaseRun, RunFailed, params_folder
from piezo_sim.experiment.on_nodes.conductor import Conductor, alone
from piezo_sim.experiment.on_nodes.processes import NodeProcesses

STALL = 30.0  # s without a new sample after which a run is given up
DRAIN = 10.0  # s that the recorder may need to write the rest


class Interrupted(RunFailed):
    """SIGINT or SIGTERM came while an experiment ran."""


def run_cases(
    cases: Iterable[Case], out: Path, namespace: str, progress: Progress
) -> Iterator[CaseRun]:
    """Run `cases` one after the other on the same node processes; bags go to `out`/bags.

    Raises ParameterError when others run in the namespace, NodeDied when a node process ends,
    RunFailed when a run does not, Interrupted on SIGINT and SIGTERM. Whatever happens, no process
    is left behind.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    discovery = params_folder() / "discovery.xml"
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(discovery))
    with alone(f"/{namespace}", instead="--namespace"):
        spin.init()
        stop = stop_at_signals()
        commands = {
            name: ["--ros-args", "-r", f"__ns:=/{namespace}", "-p", "autostart:=false"]
            for name in NODES
        }
        try:
            with NodeProcesses(commands, out / "log") as processes:

                def check() -> None:
                    if stop.is_set():
                        raise Interrupted(
                            "interrupted: nodes stopped, the last bag may be incomplete"
                        )
                    processes.check()

                conductor = Conductor(NODES, namespace, check)
                try:
                    conductor.wait_for_nodes()
                    for case in cases:
                        yield run_case(
                            case, conductor, out / "bags" / case.name, len(processes), progress
                        )
                finally:
                    conductor.close()
        finally:
            rclpy.try_shutdown()


def run_case(
    case: Case, conductor: Conductor, bag: Path, processes: int, progress: Progress
) -> CaseRun:
    """Run one case on the conducted nodes, from configuring them to the closed bag."""
    task = progress.add_task(case.name, total=case.samples)
    conductor.configure(case.parameters(bag))
    conductor.publish("reference", case.reference)
    conductor.publish("tip_force", case.tip_force)
    conductor.finger = FingerState()
    conductor.activate(NODES)
    finger = wait_for_phase(conductor, (FingerState.RUNNING, FingerState.FINISHED), lambda _: None)
    begin, first = time.monotonic(), finger.samples
    finger = wait_for_phase(
        conductor, (FingerState.FINISHED,), lambda n: progress.update(task, completed=n)
    )
    seconds = time.monotonic() - begin
    conductor.wait(
        lambda: is_complete(conductor, case.samples), DRAIN, f"bag {bag} of {case.samples} samples"
    )
    conductor.deactivate(reversed(NODES))
    progress.update(task, completed=case.samples)
    return CaseRun(case, bag, (finger.samples - first) / seconds, processes)


def wait_for_phase(
    conductor: Conductor, phases: tuple[int, ...], report: Callable[[int], None]
) -> FingerState:
    """Wait until the finger is in one of `phases`; raise RunFailed for a fault or a stall."""
    last, since = -1, time.monotonic()

    def arrived() -> bool:
        nonlocal last, since
        finger = conductor.finger
        if finger.phase == FingerState.FAULT:
            raise RunFailed(f"node 'cantilever' stopped at sample {finger.samples}: {finger.text}")
        if finger.samples != last:
            last, since = finger.samples, time.monotonic()
            report(last)
        elif time.monotonic() - since > STALL:
            raise RunFailed(f"no new sample for {STALL:g} s after {last}: {finger.text}")
        return finger.phase in phases

    conductor.wait(arrived, float("inf"), "the run")
    return conductor.finger


def is_complete(conductor: Conductor, samples: int) -> bool:
    """Say whether the recorder has every sample of the loop's topics."""
    recorder = conductor.recorder
    recorded = dict(zip(recorder.topics, recorder.recorded))
    missing = dict(zip(recorder.topics, recorder.missing))
    loop = ("deflection", "command", "voltage")
    for topic in loop:
        if missing.get(topic):
            raise RunFailed(f"node 'recorder' missed {missing[topic]} samples of '{topic}'")
    profiles = ("reference_profile", "tip_force_profile")
    return all(recorded.get(topic) == samples for topic in loop) and all(
        map(recorded.get, profiles)
    )
