# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo: what is drawn, that it can be interrupted, and that it refuses to mix studies."""

from pathlib import Path

import numpy as np
import pytest

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.metrics import step_metrics
from piezo_control.parameters import ParameterError, build, load
from piezo_control.profile import Profile
from piezo_sim import engine
from piezo_sim.experiment import monte_carlo
from piezo_sim.experiment.monte_carlo import CHUNK, Study, deviate
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

PARAMS = Path(__file__).parent.parent / "params"
PAPER = build(FeedbackParameters, load(PARAMS / "feedback_paper.yaml", "feedback"))
SHORT = Study(feedback=PAPER, samples=50)


@pytest.mark.parametrize("plant", ["prandtl_ishlinskii", "truth"])
def test_a_deviating_finger_has_the_resonance_damping_and_stroke_asked_for(plant):
    nominal = CantileverParameters(plant=plant)
    other = deviate(nominal, resonance=0.8, damping=1.5, gain=1.1)
    (a2, a1, _), (b2, b1, _) = nominal.dynamics.denominator, other.dynamics.denominator
    assert b2**-0.5 == pytest.approx(0.8 * a2**-0.5)
    assert b1 / b2**0.5 == pytest.approx(1.5 * a1 / a2**0.5)  # 2 x damping ratio
    voltage = Profile([0.0, 0.1], [0.0, 40.0], linear=True)
    degc = TemperatureParameters()
    strokes = [engine.drive(p, degc, voltage, 1000).true_deflection[-1] for p in (nominal, other)]
    assert strokes[1] / strokes[0] == pytest.approx(1.1, rel=2e-3)  # creep keeps its size


def test_draws_fill_the_box():
    study = Study(resonance=0.2, damping=0.5, gain=0.1)
    deviations = np.concatenate([study.factors(chunk) for chunk in range(20)]) - 1.0
    relative = deviations / [0.2, 0.5, 0.1]
    assert np.max(np.abs(relative)) <= 1.0
    # Uniform on [-1, 1]: standard deviation of a mean of 10,000 is 0.0058, times 4.
    assert np.mean(relative, axis=0) == pytest.approx([0.0] * 3, abs=0.023)
    assert np.var(relative, axis=0) == pytest.approx([1 / 3] * 3, rel=0.05)


def test_a_box_without_width_gives_the_nominal_step(tmp_path):
    study = Study(feedback=PAPER, resonance=0.0, damping=0.0, gain=0.0)
    draws = monte_carlo.monte_carlo(study, 1, tmp_path, workers=1)
    run = engine.run(
        CantileverParameters(seed=0), FeedforwardParameters(), PAPER, TemperatureParameters(),
        Profile([0.0], [20e-6]), 600,
    )  # fmt: skip
    expected = step_metrics(run.time, run.deflection, 20e-6)
    assert [values[0] for values in draws.metrics] == list(expected)
    assert draws.factors.tolist() == [[1.0, 1.0, 1.0]]


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
    assert monte_carlo.main([str(tmp_path / "none.yaml"), "--out", str(tmp_path)]) == 1
    assert "none.yaml: cannot be read" in capsys.readouterr().err
