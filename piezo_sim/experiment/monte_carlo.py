# SPDX-License-Identifier: Apache-2.0
"""Step responses over an uncertainty box: how a controller does on fingers that are not the nominal one.

Resonance, damping and gain of the cantilever are drawn uniformly from a box; each draw is one run of
the engine and the figures of its step response. Draws come in chunks of CHUNK, each a file of its own,
so an interrupted study goes on where it stopped and gives the same numbers as an uninterrupted one.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.metrics import StepMetrics, step_metrics
from piezo_control.parameters import ParameterError, build, load
from piezo_control.profile import Profile
from piezo_sim.engine import run
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

CHUNK = 500
FACTORS = ("resonance", "damping", "gain")


@dataclass(frozen=True)
class Study:
    """What is drawn and run: nominal finger, half-widths of the box, the step and the seed."""

    plant: CantileverParameters = field(default_factory=CantileverParameters)
    feedforward: FeedforwardParameters = field(default_factory=FeedforwardParameters)
    feedback: FeedbackParameters = field(default_factory=FeedbackParameters)
    temperatures: TemperatureParameters = field(default_factory=TemperatureParameters)
    resonance: float = 0.2
    """Largest relative deviation of the resonance frequency, below 1; of the next two likewise."""
    damping: float = 0.5
    gain: float = 0.1
    step: float = 20e-6
    """Step of the reference at sample 0, m."""
    samples: int = 600
    seed: int = 1

    def __post_init__(self) -> None:
        for name in FACTORS:
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ParameterError(f"'{name}' is {getattr(self, name)}, must be in [0, 1)")

    def factors(self, chunk: int) -> np.ndarray:
        """Return the factors on resonance, damping and gain of a chunk, shape (CHUNK, 3)."""
        random = np.random.default_rng([self.seed, chunk])
        widths = [getattr(self, name) for name in FACTORS]
        return 1.0 + widths * random.uniform(-1.0, 1.0, (CHUNK, len(FACTORS)))


@dataclass(frozen=True)
class Draws:
    """Factors, shape (draws, 3) as in FACTORS, and a StepMetrics of arrays with shape (draws,)."""

    factors: np.ndarray
    metrics: StepMetrics


def deviate(
    plant: CantileverParameters, resonance: float, damping: float, gain: float
) -> CantileverParameters:
    """Return `plant` with these factors on resonance, damping ratio and stroke."""
    inertia, friction, stiffness = plant.dynamics.denominator
    denominator = (inertia / resonance**2, friction * damping / resonance, stiffness)
    hysteresis = plant.hysteresis
    return replace(
        plant,
        dynamics=replace(plant.dynamics, denominator=denominator),
        hysteresis=replace(hysteresis, weights=tuple(gain * w for w in hysteresis.weights)),
        truth=replace(plant.truth, slope=gain * plant.truth.slope, alpha=gain * plant.truth.alpha),
    )


def run_chunk(study: Study, chunk: int) -> np.ndarray:
    """Return factors and metrics of the draws of a chunk, shape (CHUNK, 3 + metrics)."""
    first = chunk * CHUNK
    factors = study.factors(chunk).tolist()
    return np.array([(*f, *run_draw(study, f, first + n)) for n, f in enumerate(factors)])


def run_draw(study: Study, factors: Sequence[float], seed: int) -> StepMetrics:
    """Return the figures of one finger, with factors as in FACTORS and a seed for its sensor."""
    got = run(
        replace(deviate(study.plant, *factors), seed=seed),
        study.feedforward,
        study.feedback,
        study.temperatures,
        Profile([0.0], [study.step]),
        study.samples,
    )
    return step_metrics(got.time, got.deflection, study.step)


def monte_carlo(
    study: Study,
    draws: int,
    folder: str | Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workers: int | None = None,
) -> Draws:
    """Run `draws` draws on `workers` processes (default: all cores) and return them.

    Chunks already in `folder` are not run again; `progress` is called with the draws done and all.
    Raises ParameterError when `folder` holds draws of another study.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    study_file = folder / "study.txt"
    if study_file.exists() and study_file.read_text() != repr(study):
        raise ParameterError(f"{study_file}: belongs to another study; use another folder")
    study_file.write_text(repr(study))
    if draws < 1:
        raise ParameterError(f"'draws' is {draws}, must be 1 or more")
    files = [folder / f"chunk_{chunk:05d}.npy" for chunk in range(-(-draws // CHUNK))]
    missing = [chunk for chunk, file in enumerate(files) if not file.exists()]
    done = len(files) - len(missing)
    progress(min(done * CHUNK, draws), draws)
    if missing:
        run_draw(study, (1.0, 1.0, 1.0), 0)  # compiles the loop once, not in every process
        with ProcessPoolExecutor(workers or os.cpu_count()) as pool:
            futures = {pool.submit(run_chunk, study, chunk): chunk for chunk in missing}
            for future in as_completed(futures):
                _write(files[futures[future]], future.result())
                done += 1
                progress(min(done * CHUNK, draws), draws)
    rows = np.concatenate([np.load(file) for file in files])[:draws]
    return Draws(rows[:, : len(FACTORS)], StepMetrics(*rows[:, len(FACTORS) :].T))


def main(arguments: list[str] | None = None) -> int:
    """Command line: run a study, show its progress and print the percentiles of the figures."""
    parser = argparse.ArgumentParser(
        prog="python -m piezo_sim.experiment.monte_carlo", description=__doc__.splitlines()[0]
    )
    parser.add_argument("controller", help="parameter file of the node 'feedback'")
    parser.add_argument(
        "--out", default="out/monte_carlo", help="folder; started again, it goes on"
    )
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, help="processes; default: one per core")
    for name in FACTORS:
        parser.add_argument(
            f"--{name}", type=float, default=getattr(Study, name), help="half-width of the box"
        )
    given = parser.parse_args(arguments)
    try:
        values = load(given.controller, "feedback")
        feedback = build(FeedbackParameters, values, source=given.controller)
        widths = {name: getattr(given, name) for name in FACTORS}
        study = Study(feedback=feedback, seed=given.seed, **widths)
        result = monte_carlo(study, given.draws, given.out, _show_progress, given.workers)
    except ParameterError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{'figure':26}{'median':>12}{'95 %':>12}{'worst':>12}")
    for name, values in result.metrics._asdict().items():
        percentiles = np.percentile(values, (50, 95, 100), method="lower")
        print(f"{name:26}" + "".join(f"{value:12.4g}" for value in percentiles))
    return 0


def _show_progress(done: int, total: int) -> None:
    print(f"\r{done} of {total} draws", end="\n" if done == total else "", file=sys.stderr)


def _write(file: Path, rows: np.ndarray) -> None:
    """Write the rows so that `file` is either complete or not there."""
    unfinished = file.with_suffix(".unfinished")
    with unfinished.open("wb") as stream:
        np.save(stream, rows)
    unfinished.replace(file)


if __name__ == "__main__":
    sys.exit(main())
