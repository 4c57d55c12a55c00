# SPDX-License-Identifier: Apache-2.0
"""Measures the speed of everything and writes out/bench.json, out/bench.html and the jitter's histogram.

Every row is a ratio against a reference measured in the same run, or against the limit it must keep;
docs/benchmarks.md explains them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import engine
import loop
import matplotlib
import numpy as np
import servo
from engine import row
from rich.console import Console

from piezo_control.hysteresis import Hysteresis, HysteresisParameters
from piezo_control.identification.hysteresis import equal_thresholds, identify_hysteresis
from piezo_control.identification.measurement import Measurement
from piezo_control.report.page import Section, print_table, write_html
from piezo_sim.experiment.plots import save

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = ("what", "value", "unit", "reference", "ratio")


def identification() -> list[dict[str, Any]]:
    """Seconds to identify 20 plays from 100,000 samples, against the 1 s that it may take."""
    count = 100_000
    instants = np.linspace(0.0, 20.0, count)
    voltage = 40.0 * (1.0 - instants / 20.0) * np.sin(2.0 * np.pi * instants)
    deflection = Hysteresis(HysteresisParameters(), 2e-4)(voltage)
    deflection += 5e-9 * np.random.default_rng(1).standard_normal(count)
    measurement = Measurement("bench", instants, voltage, deflection, None, None, np.arange(count))
    rows = []
    for what, lag in (("lag known, as of bags", 0.0), ("lag searched, as of text files", None)):
        begin = time.perf_counter()
        identify_hysteresis(measurement, equal_thresholds(measurement, 20), lag=lag)
        name = f"identification, 1e5 samples, 20 plays, {what}"
        rows.append(row(name, time.perf_counter() - begin, "s", 1.0))
    return rows


def synthesis(folder: Path) -> list[dict[str, Any]]:
    """Seconds of `synthesize` with certificate, start of Python included, against 10 s."""
    command = [
        "synthesize", str(ROOT / "params" / "synthesis_robust.yaml"),
        "--out", str(folder / "feedback.yaml"), "--report", str(folder / "synthesis"),
    ]  # fmt: skip
    begin = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return [row("synthesize with certificate", time.perf_counter() - begin, "s", 10.0)]


def draw(histograms: dict[str, np.ndarray], path: Path) -> Path:
    """Draw the distribution of the free-running periods around the sample time."""
    figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for label, periods in histograms.items():
        rate = 1.0 / np.median(periods)
        deviation = np.clip(periods * rate - 1.0, -0.3, 0.3) * 100
        axis.hist(deviation, 121, histtype="step", log=True, label=f"{label}, {rate:.0f} Hz")
    for edge in (-100 * loop.TOLERANCE, 100 * loop.TOLERANCE):
        axis.axvline(edge, color="k", ls=":", lw=0.9)
    axis.set(xlabel="period, deviation from the sample time [%]", ylabel="periods")
    axis.legend()
    return save(figure, path)


def measure(folder: Path, histograms: dict[str, np.ndarray]) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows group by group; `histograms` gets the periods of the free-running loops."""
    yield engine.rows()
    yield identification()
    yield synthesis(folder)
    yield servo.rows(folder)
    yield loop.start_up(folder)
    yield loop.lockstep(folder)
    yield loop.responsiveness(folder)
    yield loop.recording(folder, folder)
    rows, periods = loop.free_running(folder)
    histograms.update(periods)
    yield rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench.json")
    out = parser.parse_args().out
    out.parent.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    console = Console(width=140)
    rows: list[dict[str, Any]] = []
    histograms: dict[str, np.ndarray] = {}
    with tempfile.TemporaryDirectory() as folder:
        for group in measure(Path(folder), histograms):
            for line in group:
                console.print(f"{line['name']}: {line['value']:.4g} {line['unit']}")
            rows += group
    out.write_text(json.dumps(rows, indent=2) + "\n")
    cells = [
        [r["name"], f"{r['value']:.4g}", r["unit"], f"{r['reference']:.4g}", f"{r['ratio']:.2f}"]
        for r in rows
    ]
    picture = draw(histograms, out.with_name("bench_jitter.png"))
    table = Section("Speed", "", [(picture, "Periods of the free-running loop.")], COLUMNS, cells)
    write_html(out.with_suffix(".html"), "Benchmarks", [table])
    print_table(console, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
