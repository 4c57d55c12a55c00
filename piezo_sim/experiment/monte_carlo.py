# SPDX-License-Identifier: Apache-2.0
"""Step responses over an uncertainty box: how a controller does on fingers that are not the nominal one.

Resonance, damping and stroke of the cantilever are drawn uniformly from a box; each draw is one finger's
step response in the compiled loop, and its figures. Draws come in chunks of CHUNK, each a file of its own,
so an interrupted study goes on where it stopped and gives the same numbers as an uninterrupted one,
whoever computes the chunks: the cores of this machine, or the workers of a dask scheduler.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from piezo_control.feedback import FeedbackParameters, read_controller, uncovered
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.metrics import StepMetrics, step_metrics
from piezo_control.options import output_folder
from piezo_control.parameters import ParameterError, build
from piezo_control.profile import Profile
from piezo_control.thermal import REFERENCE_DEGC
from piezo_sim.engine import Deviations, run_deviating
from piezo_sim.experiment.cases import need_parameters, own_parameters
from piezo_sim.plant.cantilever import CantileverParameters

CHUNK = 500
FACTORS = Deviations._fields
SCHEDULER_TIMEOUT = 30  # s
RETRIES = 10


@dataclass(frozen=True)
class Study:
    """What is drawn and run: nominal finger, half-widths of the box, the step and the seed."""

    plant: CantileverParameters = field(default_factory=CantileverParameters)
    feedforward: FeedforwardParameters = field(default_factory=FeedforwardParameters)
    feedback: FeedbackParameters = field(default_factory=FeedbackParameters)
    temperature_degc: float = REFERENCE_DEGC
    resonance: float = 0.2
    """Largest relative deviation of the resonance frequency, below 1; of the next two likewise."""
    damping: float = 0.5
    stroke: float = 0.1
    step: float = 20e-6
    """Step of the reference at sample 0, m."""
    samples: int = 600
    seed: int = 1

    def __post_init__(self) -> None:
        for name in FACTORS:
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ParameterError(f"'{name}' is {getattr(self, name)}, must be in [0, 1)")
        finger, controller = self.plant, self.feedback
        for name, here, there in (
            ("sample_time", finger.sample_time, controller.sample_time),
            ("delay_samples", finger.sensor.delay_samples, controller.delay_samples),
        ):
            if here != there:
                raise ParameterError(f"'{name}' of the controller is {there}, of the finger {here}")
        low, high = Feedforward(self.feedforward, finger.sample_time).reachable_range
        if not low <= self.step <= high:
            raise ParameterError(
                f"'step' is {self.step * 1e6:g} µm, must be in the finger's reach of {low * 1e6:.4g} to "
                f"{high * 1e6:.4g} µm"
            )

    def factors(self, chunk: int) -> np.ndarray:
        """Return the factors on resonance, damping and stroke of a chunk, shape (CHUNK, 3)."""
        random = np.random.default_rng([self.seed, chunk])
        widths = [getattr(self, name) for name in FACTORS]
        return 1.0 + widths * random.uniform(-1.0, 1.0, (CHUNK, len(FACTORS)))


@dataclass(frozen=True)
class Draws:
    """Factors, shape (draws, 3) as in FACTORS, and a StepMetrics of arrays with shape (draws,)."""

    factors: np.ndarray
    metrics: StepMetrics


def run_chunk(study: Study, chunk: int) -> np.ndarray:
    """Return factors and metrics of the draws of a chunk, shape (CHUNK, 3 + metrics)."""
    return run_draws(study, study.factors(chunk), np.random.default_rng([study.seed, chunk, 1]))


def run_draws(study: Study, factors: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return `factors`, shape (draws, 3) as in FACTORS, and beside them the figures of each draw."""
    deflection = run_deviating(
        study.plant,
        study.feedforward,
        study.feedback,
        study.temperature_degc,
        Profile([0.0], [study.step]),
        study.samples,
        Deviations(*np.ascontiguousarray(factors.T)),
        random,
    )
    time = np.arange(study.samples) * study.plant.sample_time
    return np.column_stack([factors, *step_metrics(time, deflection, study.step)])


@contextmanager
def executor_of(workers: int | None, scheduler: str | None) -> Iterator[Executor]:
    """Return processes of this machine, all cores by default, or the workers of a dask `scheduler`.

    Raises ParameterError when dask.distributed is not installed or the scheduler does not answer.
    """
    if scheduler is None:
        with ProcessPoolExecutor(workers or os.cpu_count()) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError:
        raise ParameterError(
            "'scheduler' needs dask.distributed: pip install 'piezo_gripper[cluster]'"
        ) from None
    try:
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT)
    except OSError as error:
        raise ParameterError(f"'scheduler' {scheduler} does not answer: {error}") from None
    with client:
        # A chunk whose worker is lost is a chunk that another worker computes, as often as it takes.
        yield client.get_executor(retries=RETRIES)


def monte_carlo(
    study: Study,
    draws: int,
    folder: str | Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Draws:
    """Run `draws` draws on `workers` processes (default: all cores), or on a dask `scheduler`, and return them.

    Chunks already in `folder` are not run again; `progress` is called with the draws done and all.
    Raises ParameterError when `folder` holds draws of another study.
    """
    for name, least, most, value in (
        ("draws", 1, 10**8, draws),
        ("workers", 1, 10**4, workers),
        ("seed", 0, 2**63 - 1, study.seed),
        ("samples", 2, 10**6, study.samples),
    ):
        if value is not None and not least <= value <= most:
            raise ParameterError(f"'{name}' is {value}, must be in [{least}, {most}]")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    study_file = folder / "study.txt"
    if study_file.exists() and study_file.read_text() != repr(study):
        raise ParameterError(f"{study_file}: belongs to another study; use another folder")
    study_file.write_text(repr(study))
    files = [folder / f"chunk_{chunk:05d}.npy" for chunk in range(-(-draws // CHUNK))]
    missing = [chunk for chunk, file in enumerate(files) if not file.exists()]
    done = len(files) - len(missing)
    progress(min(done * CHUNK, draws), draws)
    if missing:
        # Compiles the loop once, not in every process.
        run_draws(study, np.ones((1, len(FACTORS))), np.random.default_rng(0))
        with executor_of(workers, scheduler) as executor:
            futures = {executor.submit(run_chunk, study, chunk): chunk for chunk in missing}
            for future in as_completed(futures):
                _write(files[futures[future]], future.result())
                done += 1
                progress(min(done * CHUNK, draws), draws)
    rows = np.concatenate([np.load(file) for file in files])[:draws]
    return Draws(rows[:, : len(FACTORS)], StepMetrics(*rows[:, len(FACTORS) :].T))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line: a study, its progress, the percentiles; return 0 done, 2 unusable input."""
    parser = argparse.ArgumentParser(prog="monte_carlo", description=__doc__.splitlines()[0])
    parser.add_argument(
        "controller", help="name of a shipped controller, or parameter file of the node 'feedback'"
    )
    parser.add_argument(
        "--out",
        type=output_folder,
        default="out/monte_carlo",
        help="folder; started again, it goes on",
    )
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--params", type=Path, metavar="DIR",
        help="folder whose cantilever.yaml and feedforward.yaml are the finger, as of `identify`",
    )  # fmt: skip
    parser.add_argument("--step", type=float, default=Study.step, help="of the reference, in m")
    parser.add_argument(
        "--samples", type=int, default=Study.samples, help="length of each response"
    )
    parser.add_argument("--workers", type=int, help="processes; default: one per core")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="run on the workers of this dask scheduler instead"
    )
    for name in FACTORS:
        parser.add_argument(
            f"--{name}", type=float, default=getattr(Study, name), help="half-width of the box"
        )
    given = parser.parse_args(arguments)
    try:
        feedback = read_controller(given.controller)
        widths = {name: getattr(given, name) for name in FACTORS}
        if given.params:
            need_parameters(given.params)
        study = Study(
            plant=build(CantileverParameters, own_parameters(given.params, "cantilever")),
            feedforward=build(FeedforwardParameters, own_parameters(given.params, "feedforward")),
            feedback=feedback,
            step=given.step,
            samples=given.samples,
            seed=given.seed,
            **widths,
        )
        reach = Feedforward(study.feedforward, study.plant.sample_time).reachable_range
        steady = True  # the temperature: what the gain may be is said by the box
        for words in uncovered(
            feedback,
            study.plant.sensor.delay_samples,
            study.plant.dynamics.denominator,
            reach,
            steady,
        ):
            print(f"monte_carlo: controller '{given.controller}': {words}", file=sys.stderr)
        result = monte_carlo(
            study, given.draws, given.out, _show_progress, given.workers, given.scheduler
        )
    except (ParameterError, OSError) as error:
        print(f"monte_carlo: {error}", file=sys.stderr)
        return 2
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
