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
from piezo_control.design.linear_loop import closed_loop, fingers, spectral_radius
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
    """Behind the largest gain, which is that of the finger and not of the first mode alone."""
    problem = DesignProblem(uncertainty=Uncertainty(unmodelled_share=0.1, gain_high=1.17))
    random = np.random.default_rng(5)
    angle = np.linspace(0.0, math.pi, 2001)
    weight = 1.01 * unmodelled_weight(problem, angle)
    for hertz in [2000.0, 4178.0, 9999.0, 10001.0, *random.uniform(2e3, 6e4, 60)]:
        response = mode(np.exp(1j * angle), 2.0 * math.pi * hertz, random.uniform(0.017, 0.1))
        assert np.all(1.17 * 0.1 * np.abs(response) <= weight)
    assert weight[0] == pytest.approx(
        1.17 * 0.101
    )  # a mode moves nothing but the static share at rest


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


@pytest.mark.parametrize("middle", [(0.3, 0.4, 0.5), (0.3, 0.4, 1.0), (1.0, 0.6, 3.0)])
def test_the_enclosure_of_a_damped_mode_holds_on_both_sides_of_critical_damping(middle):
    """Angle of z, natural frequency (rad per sample), damping ratio; scipy's hold is what lies inside."""
    random = np.random.default_rng(1)
    half = 1e-3 * np.array(middle)
    da = (1.0 + 2.0 * (middle[2] + half[2])) * half[1] + 2.0 * (middle[1] + half[1]) * half[2]
    z, zeta = np.exp(1j * np.array([middle[0]])), np.array([middle[2]])
    g, off = robustness._damped_mode(z, half[:1], np.array([middle[1]]), zeta, np.array([da]))
    assert off[0] < 0.1
    for change in random.uniform(-1.0, 1.0, (50, 3)):
        angle, omega, damping = middle + half * change
        assert abs(mode(np.exp(1j * angle), omega / H, damping) - g[0]) <= off[0]


def test_a_box_with_fingers_that_do_not_ring_is_proven_or_refuted_by_a_finger():
    problem, controller = shipped("robust")
    u = dataclasses.replace(problem.uncertainty, damping_high=80.0)
    problem = dataclasses.replace(problem, uncertainty=u)
    z = np.exp(1j * np.geomspace(1e-4, math.pi, 20_000))
    peak = max(
        np.max(1.0 / np.abs(1.0 + gain * feedback(controller, z) * mode(z, w * NATURAL, d * RATIO) / z))
        for gain in (u.gain_low, u.gain_high) for w in (0.9, 1.0, 1.1) for d in (0.5, 5.0, 60.0, 80.0)
    )  # fmt: skip
    assert prove(problem, controller, 0.1, smallest=1.0 / (1.1 * peak)).holds
    assert not prove(problem, controller, 0.1, smallest=1.0 / (0.99 * peak)).holds


def test_a_mode_behind_the_largest_gain_refutes_the_fast_controller():
    """share 0.0105, 4997 Hz, gain +17 %, resonance -20 %, half the damping: its poles are outside the unit circle."""
    problem, controller = shipped("fast")
    u = dataclasses.replace(problem.uncertainty, unmodelled_share=0.0105)
    problem = dataclasses.replace(problem, uncertainty=u)
    worst = fingers(
        problem.finger, (0.8,), (u.damping_low,), (u.gain_high,),
        (ModesParameters((4997.4,), (u.unmodelled_damping,), (-0.0105,)),),
    )  # fmt: skip
    assert spectral_radius(closed_loop(worst, controller))[0] > 1.0
    assert not prove(problem, controller, 0.2, unmodelled=1.0).holds


def test_no_mode_beside_modelled_ones_leaves_what_is_proven():
    """The share of a mode that nobody modelled is taken from the first mode, not from those that are modelled."""
    problem, controller = shipped("robust")
    modes = ModesParameters((4178.0,), (0.017,), (0.3,))
    problem = dataclasses.replace(problem, finger=dataclasses.replace(problem.finger, modes=modes))
    u, z = problem.uncertainty, np.exp(1j * np.linspace(0.01, math.pi, 4001))
    weight = unmodelled_weight(problem, np.angle(z))
    random = np.random.default_rng(2)
    change = u.unmodelled_share / 0.7
    for _ in range(30):
        gain, share = (
            random.uniform(u.gain_low, u.gain_high),
            u.unmodelled_share * random.uniform(-1, 1),
        )
        hertz = math.exp(random.uniform(math.log(u.unmodelled_from_hz), math.log(20_000.0)))
        w, d = NATURAL * random.uniform(0.8, 1.2), RATIO * random.uniform(0.5, 2.0)
        first, second = mode(z, w, d), mode(z, 2.0 * math.pi * 4178.0, 0.017)
        other = mode(z, 2.0 * math.pi * hertz, u.unmodelled_damping)
        plant = gain * ((0.7 - share) * first + 0.3 * second + share * other)
        scaled = gain * (1.0 - share / 0.7) * (0.7 * first + 0.3 * second)
        assert abs(share / 0.7) <= change
        assert np.all(np.abs(plant - scaled) <= weight * (1.0 + 1e-3) + 1e-12)
