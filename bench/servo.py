# SPDX-License-Identifier: Apache-2.0
"""The servo's loop: how well it keeps time beside a bare loop in C, and what a sample costs."""

from __future__ import annotations

import subprocess
import sysconfig
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from engine import row

from piezo_control.compiled import compiled
from piezo_control.feedback import FeedbackParameters, read_controller
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.hysteresis import HysteresisParameters
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.servo.driver import FRESH
from piezo_control.servo.law import (
    Laws,
    Settings,
    Watch,
    laws_of,
    servo_step,
    settings_of,
    watch_at_rest,
)
from piezo_control.servo.loop import Servo
from piezo_control.servo.parameters import ServoParameters
from piezo_sim.driver import Simulation

PRIORITY = 80
SPIN = 5e-5  # s
SECONDS = 4.0
PLAYS = 10
PATIENT = ServoParameters(missed_limit=10**6, late_share=1.0, hold_time=60.0)


@contextmanager
def busy(cores: int):
    """Keep this many cores busy with other processes."""
    command = ["sh", "-c", "while :; do :; done"]
    burning = [subprocess.Popen(command) for _ in range(cores)]
    try:
        yield
    finally:
        for process in burning:
            process.kill()
            process.wait()


def in_time(servos: int = 1, sample_time: float = SAMPLE_TIME) -> tuple[float, float]:
    """Return the shares of periods that servos begin within a tenth of their period, and that they miss."""
    is_certified = sample_time == SAMPLE_TIME
    controller = (
        read_controller("robust") if is_certified else FeedbackParameters(sample_time=sample_time)
    )
    running = []
    for _ in range(servos):
        driver = Simulation("", sample_time) if is_certified else Idle()
        running.append(
            Servo(driver, PATIENT, controller, FeedforwardParameters(), PRIORITY, -1, SPIN)
        )
    for servo in running:
        servo.start()
    time.sleep(SECONDS)
    good, served, missed = 0, 0, 0
    for servo in running:
        lateness = servo.lateness
        good += int(lateness[: max(1, round(sample_time * 1e5))].sum())
        served += int(lateness.sum())
        missed += servo.missed
        servo.stop()
    return good / (served + missed), missed / (served + missed)


class Idle:
    """A device that reads zero: the loop alone, at rates that the simulated finger has no time for."""

    def __init__(self) -> None:
        self.device = Reading(np.zeros(2))
        self.read = read_idle
        self.write = write_idle

    def error(self) -> str:
        return ""

    def close(self) -> None:
        pass


class Reading(NamedTuple):
    reading: np.ndarray


def read_idle(device: Reading, _: int) -> int:
    return 0


def write_idle(device: Reading, voltage: float, _: int) -> int:
    return 0


def bare_loop(folder: Path) -> float:
    """Return the share of periods that the loop in C begins within a tenth of a period of 0.1 ms."""
    program = folder / "bare_loop"
    if not program.exists():
        compiler = sysconfig.get_config_var("CC").split()[0]
        source = Path(__file__).with_name("bare_loop.c")
        subprocess.run([compiler, "-O2", "-o", program, source], check=True)
    arguments = [str(round(SECONDS * 1e4)), "100000", str(round(SPIN * 1e9)), str(PRIORITY)]
    return float(subprocess.run([program, *arguments], check=True, capture_output=True).stdout)


def run_steps(settings: Settings, laws: Laws, watch: Watch, references: np.ndarray) -> None:
    for n in range(len(references)):
        # What the tip falls short by moves the voltage over half its range, and with it the plays.
        reading = 0.97 * references[n]
        servo_step(settings, laws, watch, 0, FRESH, reading, 0.0, references[n], 1.0)


def cost() -> float:
    """Return the time (s) of one sample of the law with 10 plays each way."""
    hysteresis = HysteresisParameters(
        thresholds=tuple(3.0 * i for i in range(PLAYS)), weights=(3e-7, *[4e-8] * (PLAYS - 1))
    )
    feedforward = FeedforwardParameters(hysteresis=hysteresis)
    settings = settings_of(ServoParameters(), feedforward, SAMPLE_TIME)
    laws = laws_of(read_controller("robust"), Feedforward(feedforward, SAMPLE_TIME))
    references = 5e-6 * np.sin(2e-3 * np.arange(300_000))
    loop = compiled(run_steps)
    loop(settings, laws, watch_at_rest(), references[:10])
    best = np.inf
    for _ in range(5):
        begin = time.perf_counter()
        loop(settings, laws, watch_at_rest(), references)
        best = min(best, time.perf_counter() - begin)
    return best / len(references)


def rows(folder: Path) -> list[dict[str, Any]]:
    found = [row("servo, time per sample, 10 plays each way", 1e6 * cost(), "us", 2.0)]
    in_time()  # compiles
    for name, cores in (("", 0), (", both cores busy", 2)):
        with busy(cores):
            # One after the other, twice: what else the machine does changes from second to second.
            bare = [bare_loop(folder)]
            servo = [in_time()[0]]
            servo.append(in_time()[0])
            bare.append(bare_loop(folder))
        found.append(
            row(
                f"servo, periods within 10 % at 10 kHz{name}",
                np.mean(servo),
                "of all",
                np.mean(bare),
            )
        )
    found.append(
        row("two servos, periods within 10 % at 10 kHz", in_time(2)[0], "of all", bare_loop(folder))
    )
    best = 0.0
    for rate in (50.0, 1e3, 1e4, 2e4, 5e4, 1e5, 2e5):
        if in_time(sample_time=1.0 / rate)[1] < 0.01:
            best = rate
    found.append(row("servo, highest rate with less than 1 % missed", best, "Hz", 1e4))
    return found
