# SPDX-License-Identifier: Apache-2.0
"""The proof over the continuous box: its enclosures against points inside them, its verdicts against fingers."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, ss2tf

from piezo_control.design import robustness
from piezo_control.design.problem import DesignProblem, Uncertainty
from piezo_control.design.robustness import prove, unmodelled_weight
from piezo_control.dynamics import ModesParameters
from piezo_control.feedback import FeedbackParameters
from piezo_control.parameters import build, load

PARAMS = Path(__file__).resolve().parents[1] / "params"
H = 1e-4
NATURAL, RATIO = 1.0 / math.sqrt(5.7e-8), 0.5 * 8.1e-6 / math.sqrt(5.7e-8)


def shipped(name: str) -> tuple[DesignProblem, FeedbackParameters]:
    problem = PARAMS / f"synthesis_{name}.yaml"
    controller = PARAMS / f"feedback_{name}.yaml"
    return (
        build(DesignProblem, load(problem, "synthesize")),
        build(FeedbackParameters, load(controller, "feedback")),
    )


def feedback(controller: FeedbackParameters, z):
    size = controller.order
    numerator, denominator = ss2tf(
        np.reshape(controller.a, (size, size)), np.reshape(controller.b, (size, 1)),
        np.reshape(controller.c, (1, size)), [[controller.d]],
    )  # fmt: skip
    return np.polyval(numerator[0], z) / np.polyval(denominator, z)


def mode(z, omega, zeta):
    """A mode with a static gain of 1, sampled by scipy's exact hold."""
    numerator, denominator, _ = cont2discrete(
        ([1.0], [omega**-2, 2.0 * zeta / omega, 1.0]), H, "zoh"
    )
    return np.polyval(numerator[0], z) / np.polyval(denominator, z)


@pytest.mark.parametrize("name", ["fast", "robust_delay_2", "paper"])
def test_what_a_cell_claims_holds_at_every_point_of_it(name):
    """Without integrator too (the paper's), with a second mode and the amplifier's lag."""
    problem, controller = shipped(name)
    modes = ModesParameters(frequency_hz=(4178.0,), damping=(0.017,), share=(0.08,))
    model = dataclasses.replace(problem.finger, modes=modes, amplifier_bandwidth_hz=4e3)
    loop = robustness._partial_fractions(controller, model)
    gain, smallest = (0.85, 1.2), 0.5
    random = np.random.default_rng(3)
    weight = np.full(robustness.BINS, 0.07)
    said = 0
    for _ in range(60):
        size = 10.0 ** random.uniform(-5.0, -1.0)
        middle = np.array(
            [
                random.uniform(0.02, 3.0),
                NATURAL * random.uniform(0.8, 1.2),
                RATIO * random.uniform(0.5, 2.0),
            ]
        )
        half = size * np.array([0.1, 0.3 * NATURAL, 0.3 * RATIO])
        cell = np.column_stack([middle - half, middle + half]).ravel()[:, None]
        bound, _, _ = robustness._bounds(loop, cell, gain, weight, smallest)
        said += np.isfinite(bound[0])
        for _ in range(3):
            angle, omega, zeta = middle + half * random.uniform(-1.0, 1.0, 3)
            z = np.exp(1j * angle)
            lag = math.exp(-2.0 * math.pi * 4e3 * H)
            plant = 0.92 * mode(z, omega, zeta) + 0.08 * mode(z, 2.0 * math.pi * 4178.0, 0.017)
            plant *= (1.0 - lag) / (1.0 - lag / z) / z**model.delay_samples
            k = feedback(controller, z)
            value = abs(1.0 + random.uniform(*gain) * k * plant) - smallest - 0.07 * abs(k)
            scale = 1.0 if math.isnan(loop.integral) else abs(z - 1.0)
            assert value * scale >= bound[0] - 1e-7
    assert said > 40  # most cells say something


def test_the_weight_covers_every_mode():
    u = Uncertainty(unmodelled_share=0.1)
    random = np.random.default_rng(5)
    angle = np.linspace(0.0, math.pi, 2001)
    weight = 1.01 * unmodelled_weight(u, H, angle)
    for hertz in [2000.0, 4178.0, 9999.0, 10001.0, *random.uniform(2e3, 6e4, 60)]:
        response = mode(np.exp(1j * angle), 2.0 * math.pi * hertz, random.uniform(0.017, 0.1))
        assert np.all(0.1 * np.abs(response) <= weight)
    assert weight[0] == pytest.approx(0.101)  # a mode moves nothing but the static share at rest


def test_a_claim_that_is_wrong_is_refuted_by_a_finger():
    problem, controller = shipped("robust")
    proof = prove(problem, controller, 0.1, smallest=1.0 / 1.45)
    assert not proof.holds
    hertz, resonance, damping = map(
        float,
        re.match(r"violated at (\d+) Hz .* resonance (\S+) %, damping x(\S+)$", proof.why).groups(),
    )
    z = np.exp(2j * math.pi * H * np.linspace(0.95 * hertz, 1.05 * hertz, 201))
    plant = mode(z, NATURAL * (1.0 + resonance / 100.0), RATIO * damping) / z
    worst = max(
        np.max(1.0 / np.abs(1.0 + gain * feedback(controller, z) * plant)) for gain in (0.9, 1.17)
    )
    assert worst > 1.45


@pytest.mark.parametrize("name", ["robust", "robust_delay_2", "robust_delay_3"])
def test_the_shipped_controllers_are_proven(name):
    problem, controller = shipped(name)
    assert prove(problem, controller, 0.2, unmodelled=1.0).holds
    assert prove(problem, controller, 0.1, smallest=1.0 / 1.53).holds


def test_the_fast_controller_is_not_proven_with_unmodelled_modes():
    problem, controller = shipped("fast")
    u = dataclasses.replace(problem.uncertainty, unmodelled_share=0.1)
    problem = dataclasses.replace(problem, uncertainty=u)
    proof = prove(problem, controller, 0.1, unmodelled=1.0)
    assert not proof.holds and proof.why.startswith("violated at ")


def test_a_box_of_fingers_that_do_not_ring_is_refused():
    problem, controller = shipped("robust")
    u = dataclasses.replace(problem.uncertainty, damping_high=80.0)
    proof = prove(dataclasses.replace(problem, uncertainty=u), controller, 0.1)
    assert not proof.holds and "do not ring" in proof.why
