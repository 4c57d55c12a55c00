# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo: what is drawn, that it can be interrupted, and that it refuses to mix studies."""

import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.metrics import step_metrics
from piezo_control.parameters import ParameterError, build, dump, load
from piezo_control.profile import Profile
from piezo_sim import engine
from piezo_sim.engine import Deviations
from piezo_sim.experiment import monte_carlo
from piezo_sim.experiment.monte_carlo import CHUNK, Study
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.plant.contact import ContactParameters
from piezo_sim.plant.sensor import SensorParameters
from piezo_sim.temperature import TemperatureParameters

PARAMS = Path(__file__).parent.parent / "params"
PAPER = build(FeedbackParameters, load(PARAMS / "feedback_paper.yaml", "feedback"))
SHORT = Study(feedback=PAPER, samples=50)


def deviating(plant, resonance, damping, stroke):
    """A finger's parameters with these factors, by the definitions of resonance and damping ratio."""
    a2, a1, a0 = plant.dynamics.denominator
    dynamics = replace(
        plant.dynamics, denominator=(a2 / resonance**2, a1 * damping / resonance, a0)
    )
    hysteresis = plant.hysteresis
    weights = tuple(stroke * weight for weight in hysteresis.weights)
    truth = plant.truth
    per_decade = truth.creep_per_decade / stroke  # of the deflection: creep keeps its size
    per_degc = truth.creep_per_decade_degc / stroke
    return replace(
        plant,
        dynamics=dynamics,
        hysteresis=replace(hysteresis, weights=weights),
        truth=replace(
            truth, slope=stroke * truth.slope, alpha=stroke * truth.alpha,
            creep_per_decade=per_decade, creep_per_decade_degc=per_degc,
        ),
    )  # fmt: skip


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("plant", ["prandtl_ishlinskii", "truth"])
@pytest.mark.parametrize("stiffness", [0.0, 300.0])
def test_a_batch_is_one_run_after_the_other(plant, stiffness, compiled):
    if compiled:
        pytest.importorskip("numba")
    nominal = CantileverParameters(
        plant=plant,
        sensor=SensorParameters(noise=0.0, resolution=0.0),
        contact=ContactParameters(stiffness=stiffness, damping=0.01),
    )
    factors = Deviations(
        np.array([0.8, 1.0, 1.2]), np.array([1.5, 1.0, 0.5]), np.array([1.1, 1, 0.9])
    )
    reference = Profile([0.0], [20e-6])
    degc = TemperatureParameters(base_degc=30.0)
    together = engine.run_deviating(
        nominal, FeedforwardParameters(), PAPER, 30.0, reference, 300, factors,
        np.random.default_rng(1), compiled,
    )  # fmt: skip
    for n, factor in enumerate(zip(*factors)):
        finger = deviating(nominal, *factor)
        alone = engine.run(finger, FeedforwardParameters(), PAPER, degc, reference, 300)
        np.testing.assert_allclose(together[n], alone.deflection, rtol=0.0, atol=1e-13)


def test_every_reading_of_every_draw_has_noise_of_its_own():
    noise = SensorParameters(noise=5e-9, resolution=0.0)
    readings = engine.run_deviating(
        CantileverParameters(sensor=noise), FeedforwardParameters(), FeedbackParameters(), 22.0,
        Profile([0.0], [0.0]), 500, Deviations(*np.ones((3, 40))), np.random.default_rng(1),
    )[:, 1:]  # fmt: skip
    # 20,000 independent readings: 4 standard deviations of a variance's and of a correlation's estimate
    assert np.std(readings) == pytest.approx(5e-9, rel=4 / math.sqrt(2 * 20_000))
    correlation = np.corrcoef(readings) - np.eye(40)
    assert np.max(np.abs(correlation)) < 6 / math.sqrt(500)


def test_draws_fill_the_box():
    study = Study(resonance=0.2, damping=0.5, stroke=0.1)
    deviations = np.concatenate([study.factors(chunk) for chunk in range(20)]) - 1.0
    relative = deviations / [0.2, 0.5, 0.1]
    assert np.max(np.abs(relative)) <= 1.0
    # Uniform on [-1, 1]: standard deviation of a mean of 10,000 is 0.0058, times 4.
    assert np.mean(relative, axis=0) == pytest.approx([0.0] * 3, abs=0.023)
    assert np.var(relative, axis=0) == pytest.approx([1 / 3] * 3, rel=0.05)


def test_a_box_without_width_gives_the_nominal_step(tmp_path):
    plant = CantileverParameters(sensor=SensorParameters(noise=0.0, resolution=0.0))
    study = Study(plant, feedback=PAPER, resonance=0.0, damping=0.0, stroke=0.0)
    draws = monte_carlo.monte_carlo(study, 1, tmp_path, workers=1)
    run = engine.run(
        plant, FeedforwardParameters(), PAPER, TemperatureParameters(), Profile([0.0], [20e-6]), 600
    )
    expected = step_metrics(run.time, run.deflection, 20e-6)
    assert [values[0] for values in draws.metrics] == pytest.approx(list(expected), rel=1e-9)
    assert draws.factors.tolist() == [[1.0, 1.0, 1.0]]


def test_a_lost_worker_of_a_scheduler_costs_nothing(tmp_path):
    distributed = pytest.importorskip("distributed")
    chunks = 40
    here = monte_carlo.monte_carlo(SHORT, chunks * CHUNK, tmp_path / "here", workers=1)
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    )
    lost = []

    def lose_a_worker(done, total):
        if not lost and done > 0:
            lost.append(next(iter(cluster.workers.values())).pid)
            os.kill(lost[0], signal.SIGKILL)

    with cluster:
        there = monte_carlo.monte_carlo(
            SHORT, chunks * CHUNK, tmp_path / "there", lose_a_worker,
            scheduler=cluster.scheduler_address,
        )  # fmt: skip
    assert lost
    assert np.array_equal(there.factors, here.factors)
    assert np.array_equal(there.metrics, here.metrics)


def test_a_scheduler_that_is_not_there_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(monte_carlo, "SCHEDULER_TIMEOUT", 1)
    with pytest.raises(ParameterError, match="'scheduler' tcp://127.0.0.1:1 does not answer"):
        monte_carlo.monte_carlo(SHORT, 1, tmp_path, scheduler="tcp://127.0.0.1:1")


def test_an_interrupted_study_goes_on_with_the_same_numbers(tmp_path):
    steps = []
    whole = monte_carlo.monte_carlo(SHORT, 2 * CHUNK, tmp_path, lambda *s: steps.append(s))
    assert steps == [(0, 2 * CHUNK), (CHUNK, 2 * CHUNK), (2 * CHUNK, 2 * CHUNK)]
    (tmp_path / "chunk_00001.npy").unlink()
    kept = (tmp_path / "chunk_00000.npy").stat().st_mtime_ns
    steps.clear()
    resumed = monte_carlo.monte_carlo(SHORT, 2 * CHUNK, tmp_path, lambda *s: steps.append(s))
    assert steps == [(CHUNK, 2 * CHUNK), (2 * CHUNK, 2 * CHUNK)]
    assert (tmp_path / "chunk_00000.npy").stat().st_mtime_ns == kept
    assert np.array_equal(resumed.factors, whole.factors)
    assert np.array_equal(resumed.metrics, whole.metrics)
    fewer = monte_carlo.monte_carlo(SHORT, 300, tmp_path)
    assert np.array_equal(fewer.factors, whole.factors[:300])


def test_a_folder_of_another_study_is_refused(tmp_path):
    monte_carlo.monte_carlo(SHORT, 1, tmp_path, workers=1)
    with pytest.raises(ParameterError, match="study.txt: belongs to another study"):
        monte_carlo.monte_carlo(Study(feedback=PAPER, samples=50, seed=2), 1, tmp_path)


def test_a_box_that_reaches_zero_is_refused():
    with pytest.raises(ParameterError, match="'resonance' is 1.0, must be in \\[0, 1\\)"):
        Study(resonance=1.0)


def test_command_line_prints_the_figures(tmp_path, capsys):
    file = str(PARAMS / "feedback_paper.yaml")
    assert monte_carlo.main([file, "--draws", "20", "--out", str(tmp_path), "--workers", "1"]) == 0
    printed = capsys.readouterr()
    assert "settling_5_final_s" in printed.out
    assert "20 of 20 draws" in printed.err
    assert monte_carlo.main([str(tmp_path / "none.yaml"), "--out", str(tmp_path)]) == 2
    assert "none.yaml' is no file, and not one of the known" in capsys.readouterr().err
    assert monte_carlo.main(["paper", "--out", str(tmp_path), "--workers", "0"]) == 2
    assert "'workers' is 0, must be in [1, 10000]" in capsys.readouterr().err


def test_a_controller_for_another_loop_and_a_step_out_of_reach_are_refused(tmp_path, capsys):
    for change, words in (
        ({"sample_time": 2e-5}, "'sample_time' of the controller is 2e-05, of the finger 0.0001"),
        ({"delay_samples": 3}, "'delay_samples' of the controller is 3, of the finger 1"),
    ):
        with pytest.raises(ParameterError, match=words):
            Study(feedback=replace(PAPER, **change))
    assert monte_carlo.main(["robust", "--step", "30e-6", "--out", str(tmp_path)]) == 2
    assert (
        "'step' is 30 µm, must be in the finger's reach of -22 to 22 µm" in capsys.readouterr().err
    )


def test_the_finger_of_a_folder_is_drawn_around(tmp_path, capsys):
    """Half the weights: half the reach, and so the controller's certificate does not cover it, which is said."""
    weights = tuple(0.5 * w for w in CantileverParameters().hysteresis.weights)
    for node in ("cantilever", "feedforward"):
        dump(tmp_path / f"{node}.yaml", node, {"hysteresis.weights": weights})
    command = [
        "robust",
        "--params",
        str(tmp_path),
        "--draws",
        "10",
        "--workers",
        "1",
        "--samples",
        "200",
    ]
    assert monte_carlo.main([*command, "--step", "5e-6", "--out", str(tmp_path / "a")]) == 0
    assert "leave the finger's reach of -11 to 11 µm" in capsys.readouterr().err
    assert monte_carlo.main([*command, "--out", str(tmp_path / "b")]) == 2
