# SPDX-License-Identifier: Apache-2.0
"""A campaign of faults on live nodes: random schedules, and what has to hold after every sample.

Each schedule starts the nodes of one finger as processes, lets things go wrong in an order and at times that
its seed decides (fault_events.py), and watches (fault_bench.py, and at the plant fault_plant.py). `python
test/faults.py` runs many, prints the seeds that failed, and goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import fault_bench
import fault_events
import own_domain
from fault_bench import NODES, Bench, Network
from fault_plant import LEAP
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from std_srvs.srv import Trigger

from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import SAMPLE_TYPE
from piezo_gripper_msgs.msg import FingerState, Sample

TRACEBACK = "Traceback (most recent call last):\n"
START = 60.0  # s that the loop may take to run on a busy machine
AT_RISK = 1.0  # s before the end of a process that need not be in a bag
OUTCOME = 30.0  # s until it tracks again or a fault is latched and named
TARGET = 1e-5  # m
NEAR = {True: 0.5e-6, False: 3e-6}  # m: with a controller; without, creep and warmth are not undone
CLOSED = (FingerState.FAULT, FingerState.RAMPING)

has_networks = functools.cache(fault_bench.may_make_networks)


@contextlib.contextmanager
def burners(count: int):
    """Keep so many cores busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def run_schedule(seed: int, folder: Path) -> list[str]:
    """Run one schedule; return what was violated, an empty list if nothing.

    It has a process of its own: one whose DDS was there before does not find a network that has come since. That
    watches, and makes and destroys entities for the executor of rclpy faster than any node; where it dies by a signal
    for that, about once in a thousand times, the schedule is run again, and it is said.
    """
    spawn = multiprocessing.get_context("spawn")
    for _ in range(2):
        with ProcessPoolExecutor(1, mp_context=spawn) as pool:
            try:
                return pool.submit(play, seed, folder).result()
            except BrokenProcessPool:
                print(f"seed {seed}: its watcher died", file=sys.stderr)
                shutil.rmtree(folder)
    return ["the watcher died twice"]


def play(seed: int, folder: Path) -> list[str]:
    """Run one schedule in this process."""
    draw = random.Random(seed)
    lockstep = draw.random() < 0.6
    linked = draw.choice(("", "", "deflection", "command", "voltage"))
    misfit = bool(linked) and draw.random() < 0.1
    is_loaded = draw.random() < 0.3
    is_apart = not linked and draw.random() < 0.2  # drawn alike on every machine
    is_recorded = not is_apart and linked != "deflection" and draw.random() < 0.6
    with contextlib.ExitStack() as stack:
        network = stack.enter_context(Network()) if is_apart and has_networks() else None
        bench = stack.enter_context(
            fault_bench.finger(lockstep, linked, misfit, is_recorded, network, draw, folder)
        )
        if misfit:
            has_ended = bench.wait(START, lambda: bench.finger.phase in CLOSED)
            if not (has_ended and "RELIABILITY" in bench.finger.text):
                bench.broken(f"no fault names the quality of service: '{bench.finger.text}'")
        else:
            let_go_wrong(bench, 2 * is_loaded)
        violations = bench.violations
        processes = dict(bench.processes.running)
        finger = bench.finger
        foreign = bench.foreign
        bench.ends += [(name, time.monotonic()) for name in processes]
    violations += [f"{n} is left behind" for n, p in processes.items() if p.poll() is None]
    if is_recorded and "deflection" not in foreign:
        violations += lost(bench, folder / "bag")
    logs = {path.stem: path.read_text(errors="replace") for path in folder.glob("*.log")}
    for name, words in logs.items():
        # A signal may come while Python itself starts, before a line of this package can do anything about it.
        own = words.replace(f'{TRACEBACK}  File "<frozen site>"', "")
        if TRACEBACK in own:
            violations.append(f"{name}: {words.strip().splitlines()[-1]}")
        violations += [
            f"{name}: {line}"
            for line in words.splitlines()
            if line.startswith("VIOLATED") and not (LEAP in line and "voltage" in foreign)
        ][:3]
    everything = "\n".join(logs.values())
    violations += [
        f"no log says '{words[0]}'"
        for words in bench.missing if not any(word in everything for word in words)
    ]  # fmt: skip
    if finger.phase == FingerState.FAULT and finger.text.split(": ")[-1] not in everything:
        violations.append(f"no log says '{finger.text}'")
    return violations


def lost(bench: Bench, path: Path) -> list[str]:
    """Say which deflections the bag lacks that a recorder had the time to write.

    It has everything from the moment on at which it says that it writes what a cantilever sends, but for the last
    second of that, or of its own.
    """
    if not path.exists():
        return []  # it was ended before it began
    recorded = {(s.number, s.value) for s in open_bag(path).messages("/deflection", SAMPLE_TYPE)}
    own_end = min(instant for name, instant in bench.ends if name == "recorder")
    missing, begin = [], 0.0
    for end in (instant for name, instant in bench.ends if name == "cantilever"):
        before = max((count for instant, count in bench.recorded if instant < begin), default=0)
        hears = (i for i, count in bench.recorded if i > begin and count > before)
        heard, at_risk = next(hears, math.inf), min(end, own_end) - AT_RISK
        missing += [
            n for i, n, value in bench.seen if heard < i < at_risk and (n, value) not in recorded
        ]
        begin = end + AT_RISK  # what was still on its way is there by then
    if not missing:
        return []
    return [f"{len(missing)} of {len(bench.seen)} samples are not in the bag, as {missing[:5]}"]


def is_overloaded() -> bool:
    """Say whether more than four processes wait for each core: time limits mean little then."""
    return os.getloadavg()[0] > 4 * (os.cpu_count() or 1)


def rests_by_name(bench: Bench) -> bool:
    """Say whether the finger is at rest with a reason: a fault, or samples that the log calls too old."""
    state = bench.finger
    if state.phase == FingerState.WAITING and not bench.lockstep:
        bench.missing.append(("s old, must be at most",))
    elif state.phase != FingerState.FAULT:
        return False
    return bool(state.text) and state.voltage == 0.0


def let_go_wrong(bench: Bench, cores: int) -> None:
    """Wait for the loop, let one to three things happen to it, with `cores` busy, and see how it ends."""
    moving = 200 if bench.lockstep else 20

    def is_running() -> bool:
        if (
            bench.finger.phase == FingerState.FAULT
        ):  # of a machine that is too busy for its time limits
            for name in NODES:  # the cantilever at last
                bench.call(Trigger, f"{name}/reset", Trigger.Request())
        return bench.samples > moving and bench.finger.phase == FingerState.RUNNING

    if not bench.wait(START, is_running):
        if is_overloaded() and (bench.finger.phase == FingerState.IDLE or rests_by_name(bench)):
            return  # nothing can be done to a loop that this machine does not run
        bench.broken(f"the loop did not begin to run: '{bench.finger.text}'")
        return
    kinds = [*fault_events.ALWAYS]
    kinds += [fault_events.disturb] * 5 if bench.link else []
    kinds += [fault_events.cut] * 10 if bench.processes.network else []
    chosen = bench.draw.choices(kinds, k=bench.draw.randint(1, 3))
    bench.reference.publish(Sample(value=TARGET))
    with burners(cores):
        for happen in chosen:
            bench.wait(bench.draw.uniform(0.0, 0.3))
            happen(bench)
    if len(chosen) > 1 or bench.ended:
        bench.missing.clear()  # after another event nobody may be left to say it
    for name, process in bench.processes.running.items():
        if process.poll() is not None and name not in bench.ended:
            bench.broken(f"{name} ended ({process.returncode})")
    before = bench.finger.samples
    bench.node.create_timer(0.2, lambda: bench.reference.publish(Sample(value=TARGET)))

    def is_decided() -> bool:
        state = bench.finger
        if state.phase == FingerState.FAULT:
            return bool(state.text)
        if (
            bench.ended
        ):  # what was told to end may leave a finger that is at rest or waits for it, by name
            if "cantilever" in bench.ended or state.phase == FingerState.WAITING and state.text:
                return True
        if "came up after this node started" in state.text:
            return state.phase == FingerState.WAITING and state.voltage == 0.0
        is_near = abs(state.deflection - TARGET) < NEAR[bench.lockstep]
        is_new = state.samples > before + moving or state.samples < before
        return state.phase == FingerState.RUNNING and is_new and is_near

    if not bench.wait(OUTCOME, is_decided) and not (is_overloaded() and rests_by_name(bench)):
        s = bench.finger
        bench.broken(
            f"undecided: phase {s.phase}, sample {s.samples}, {s.deflection * 1e6:.2f} µm, '{s.text}'"
        )


def main() -> int:
    """Run the campaign of the command line; return 0 when nothing was violated."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--schedules", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first schedule")
    parser.add_argument(
        "--out", type=Path, default=Path("out/faults"),
        help="folder for results.jsonl, where schedules count as done, and the logs of those that failed",
    )  # fmt: skip
    arguments = parser.parse_args()
    own_domain.take()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    results = out / "results.jsonl"
    lines = results.read_text().splitlines() if results.exists() else []
    done = {line["seed"]: line["violations"] for line in map(json.loads, lines)}
    seeds = range(arguments.seed, arguments.seed + arguments.schedules)
    if not has_networks():
        print("no rights to make network namespaces: no link between two networks is cut")
    columns = (
        TextColumn("schedules"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[failed]} failed"),
    )  # fmt: skip
    with Progress(*columns) as progress, results.open("a") as stream:
        task = progress.add_task("", total=len(seeds), failed=0)
        for seed in seeds:
            if seed not in done:
                folder = out / str(seed)
                done[seed] = run_schedule(seed, folder)
                stream.write(json.dumps({"seed": seed, "violations": done[seed]}) + "\n")
                stream.flush()
                if done[seed]:
                    text = f"seed {seed}: {'; '.join(done[seed])}"
                    progress.console.print(text, soft_wrap=True, markup=False)
                else:
                    shutil.rmtree(folder)
            progress.update(task, advance=1, failed=sum(bool(done[s]) for s in seeds if s in done))
    failed = [seed for seed in seeds if done[seed]]
    print(f"{len(seeds)} schedules, {len(failed)} with violations {failed or ''}")
    for seed in failed:
        print(f"again: python test/faults.py --schedules 1 --seed {seed} --out /tmp/again")
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("stopped; started again it goes on from here")
