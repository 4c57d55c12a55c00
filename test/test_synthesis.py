# SPDX-License-Identifier: Apache-2.0
"""The H-infinity chain against published optima, independent solvers and its own problem files."""

import dataclasses
import math
import sys
import warnings
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from hypothesis import example, given, settings
from hypothesis import strategies as st
from weights import FAST, needs_slycot

from piezo_control.design import hinf
from piezo_control.design.certificate import Box, certify
from piezo_control.design.hinf import (
    delayed_finger,
    generalised_plant,
    realised_weights,
    smallest_gamma,
    solve,
)
from piezo_control.design.linear_loop import (
    closed_loop,
    controller_response,
    fingers,
    respond,
)
from piezo_control.design.problem import (
    DesignProblem,
    FingerModel,
    Prefilter,
    SynthesisError,
    TransferFunction,
    Uncertainty,
    Weights,
)
from piezo_control.design.state_space import (
    TIME_UNIT,
    StateSpace,
    balanced,
    from_w_plane,
    realise,
    to_w_plane,
)
from piezo_control.design.structures import STRUCTURES, shaped_weights
from piezo_control.design.synthesis import synthesize
from piezo_control.feedback import FeedbackParameters
from piezo_control.parameters import ParameterError, build, load

PARAMS = Path(__file__).resolve().parents[1] / "params"
CONSTANT = TransferFunction((1.0,), (1.0,))


def matrices(*values) -> StateSpace:
    return StateSpace(*(np.atleast_2d(np.array(value, dtype=float)) for value in values))


def problem(name: str) -> DesignProblem:
    path = PARAMS / f"synthesis_{name}.yaml"
    return build(DesignProblem, load(path, "synthesize"), str(path))


# Smallest norm of [I; K] (I + G K)^-1 [I, -G], all weights 1. McFarlane and Glover, "Robust Controller
# Design Using Normalized Coprime Factor Plant Descriptions" (1990): it is sqrt(1 + lambda_max(X Z)).
# 1/s: X = Z = 1. 1/(s-1): X = Z = 1 + sqrt 2. 1/s²: 1 / sin(pi/8), Vinnicombe, "Uncertainty and
# Feedback" (2001), a double integrator's best margin being 0.383.
KNOWN = {
    "1/s": (matrices([[0]], [[1]], [[1]], [[0]]), math.sqrt(2.0)),
    "1/(s-1)": (matrices([[1]], [[1]], [[1]], [[0]]), math.sqrt(1.0 + (1.0 + math.sqrt(2.0)) ** 2)),
    "1/s²": (
        matrices([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]]),
        1.0 / math.sin(math.pi / 8.0),
    ),
}


@needs_slycot
@pytest.mark.parametrize("name", KNOWN)
def test_smallest_gamma_of_published_problems(name):
    finger, expected = KNOWN[name]
    plant = generalised_plant(finger, *(realise(CONSTANT),) * 3)
    found = smallest_gamma(plant)
    assert expected <= found <= expected * 1.011
    controller = solve(plant, found)
    loop = control.ss(*plant).lft(control.ss(*controller), 1, 1)
    assert loop.poles().real.max() < 0.0
    assert control.system_norm(loop, "inf") == pytest.approx(expected, rel=0.012)


@needs_slycot
def test_smallest_gamma_of_the_fingers_coprime_problem():
    # The same formula for the delayed finger in the w-plane, from two Riccati equations (direct term
    # included: R = 1 + d², Zhou and Doyle, "Essentials of Robust Control", 1998, ch. 16).
    a, b, c, d = to_w_plane(delayed_finger(FingerModel()), 0.1)
    r = 1.0 + d[0, 0] ** 2
    inner = a - b @ c * d[0, 0] / r
    x = scipy.linalg.solve_continuous_are(inner, b, c.T @ c / r, [[r]])
    z = scipy.linalg.solve_continuous_are(inner.T, c.T, b @ b.T / r, [[r]])
    expected = math.sqrt(1.0 + np.linalg.eigvals(x @ z).real.max())
    plant = generalised_plant(StateSpace(a, b, c, d), *(realise(CONSTANT),) * 3)
    assert expected * 0.999 <= smallest_gamma(plant) <= expected * 1.011


@pytest.mark.parametrize("hertz, delay", [(300.0, 2), (450.0, 3), (666.6, 1), (1500.0, 1)])
def test_a_search_for_another_finger_begins_stable(hertz, delay):
    """One sample of 0.1 ms is 0.15 periods at 1500 Hz, more than two are at 666.6 Hz."""
    p = problem("robust")
    omega = 2.0 * math.pi * hertz
    finger = dataclasses.replace(
        p.finger, denominator=(omega**-2.0, 0.02 / omega, 1.0), delay_samples=delay
    )
    p = dataclasses.replace(p, finger=finger)
    starts, complete = STRUCTURES[p.method]
    corners = Box(p, resonance=3, damping=3, gain=3, points=10)
    radii = [
        max(part.max() for part in corners.radius(synthesize(complete(p, np.array(x))).controller))
        for x in starts(p)
    ]
    assert min(radii) < 1.0


@needs_slycot
def test_smallest_gamma_equals_hinfsyn_of_python_control():
    p = problem("fast")
    finger = to_w_plane(delayed_finger(p.finger), p.finger.sample_time / TIME_UNIT)
    plant = generalised_plant(finger, *realised_weights(p.weights))
    without = plant.d.copy()
    without[-1, -1] = 0.0
    _, _, gamma, _ = control.hinfsyn(control.ss(plant.a, plant.b, plant.c, without), 1, 1)
    assert smallest_gamma(plant) == pytest.approx(gamma, rel=0.011)


@given(
    poles=st.lists(st.floats(-0.99, 0.99), min_size=1, max_size=4, unique=True),
    step=st.floats(1e-3, 10.0),
)
def test_w_plane_and_back_is_the_same_system(poles, step):
    size = len(poles)
    system = StateSpace(np.diag(poles), np.ones((size, 1)), np.ones((1, size)), np.eye(1))
    back = from_w_plane(to_w_plane(system, step), step)
    z = np.exp(1j * np.linspace(0.1, 3.0, 7))
    for value in z:
        responses = [
            (s.c @ np.linalg.solve(value * np.eye(size) - s.a, s.b) + s.d)[0, 0]
            for s in (system, back)
        ]
        assert abs(responses[0] - responses[1]) < 1e-8 * (1.0 + abs(responses[0]))


@needs_slycot
def test_balancing_keeps_the_response_and_truncation_its_bound():
    # |error| <= 2 sum of the Hankel singular values left out (Glover 1984), for the stable part.
    s = control.tf("s")
    transfer = 5.0 / (s + 0.01) + 1.0 / (s + 1.0) + 2.0 / (s**2 + 0.6 * s + 9.0) + 0.05 / (s + 30.0)
    numerator, denominator = (c[0][0] for c in control.tfdata(transfer))
    whole = realise(TransferFunction(tuple(numerator), tuple(denominator / 1.0)))
    frequency = 1j * np.geomspace(1e-3, 1e3, 400) * TIME_UNIT

    def response(system):
        return np.array(
            [
                (
                    system.c @ np.linalg.solve(w * np.eye(len(system.a)) - system.a, system.b)
                    + system.d
                )[0, 0]
                for w in frequency
            ]
        )

    exact = response(whole)
    np.testing.assert_allclose(response(balanced(whole)), exact, rtol=1e-6)
    stable = control.ss(transfer - control.tf(5.0 / (s + 0.01)))
    hankel = np.sort(control.hankel_singular_values(control.minimal_realization(stable, 1e-6)))
    reduced = balanced(whole, order=4)
    assert len(reduced.a) == 4
    # Glover's bound, plus what the round-off of `balanced` (the first assertion) may add.
    rounding = 1e-6 * np.abs(exact).max()
    assert np.abs(response(reduced) - exact).max() <= 2.0 * hankel[:1].sum() + rounding


def test_given_controller_is_its_tustin_transform():
    p = problem("paper")
    controller = synthesize(p).controller
    omega = np.geomspace(1.0, 3e4, 50)
    w = 2j / 1e-4 * np.tan(0.5 * omega * 1e-4)
    # Equation 13 of the paper.
    expected = 230 * (w**2 + 142 * w + 1.8e7) / ((w + 1.5) * (w**2 + 2132 * w + 1.9e7))
    found, _ = controller_response(controller, np.exp(1j * omega * 1e-4))
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_prefilter_passes_a_constant_unchanged():
    p = dataclasses.replace(problem("paper"), prefilter=Prefilter(2000.0, 0.6))
    controller = synthesize(p).controller
    feedback, reference = controller_response(controller, np.array([1.0 + 1e-9 + 0j]))
    # F(1) = 1: the path of the reference besides the error's is zero.
    assert abs(reference[0]) < 1e-6 * abs(feedback[0])


@pytest.mark.parametrize("pole", [0.0, 2500.0])
def test_the_nominal_finger_follows_its_model_and_leaves_the_controller_nothing(pole):
    """Whatever the controller: D(s) F(s) by scipy's bilinear transform, before D(s) by its hold and the delay."""
    slow = TransferFunction((100.0,), (1e-4, 1.0, 0.0))
    p = DesignProblem(
        method="given", controller=slow, prefilter=Prefilter(2000.0, 0.8, pole), feedforward=1.0,
        follows=True,
    )  # fmt: skip
    loop = closed_loop(fingers(p.finger), synthesize(p).controller)
    wished = np.polymul((1.0, 3200.0, 4e6), (1.0, pole) if pole else (1.0,))
    ahead = scipy.signal.cont2discrete(
        (wished[-1] * np.array(p.finger.denominator), wished), 1e-4, "bilinear"
    )
    plant = scipy.signal.cont2discrete(([1.0], p.finger.denominator), 1e-4, "zoh")
    command = scipy.signal.lfilter(np.ravel(ahead[0]), ahead[1], np.ones(100))
    reading = np.append(0.0, scipy.signal.lfilter(np.ravel(plant[0]), plant[1], command))
    np.testing.assert_allclose(respond(loop, "reference", 100)[0], reading[:100], atol=1e-9)
    assert reading[-1] == pytest.approx(1.0, abs=5e-3)


def test_no_finger_follows_at_once():
    with pytest.raises(ParameterError, match="'prefilter.frequency' must be above 0"):
        DesignProblem(follows=True)


@pytest.mark.parametrize("name", ["paper", FAST])
def test_shipped_controller_is_what_its_problem_gives(name):
    path = PARAMS / f"feedback_{name}.yaml"
    shipped = build(FeedbackParameters, load(path, "feedback"), str(path))
    designed = synthesize(problem(name)).controller
    z = np.exp(1j * np.geomspace(1.0, 3.1e4, 60) * shipped.sample_time)
    # Two processors round the Riccati equations differently: 1.2e-6 apart was seen beside the notch.
    np.testing.assert_allclose(
        controller_response(shipped, z), controller_response(designed, z), rtol=1e-5, atol=1e-9
    )


def test_a_baseline_is_tuned_to_the_same_specifications():
    design = synthesize(DesignProblem(method="integrator_notch"))
    certificate = certify(design.problem, design.controller, design.gamma)
    assert certificate.met, [row for row in certificate.rows if not row.met]


REGULAR = shaped_weights(300.0, 3.0, 0.3, 1e-3, 28e3, 1e5)


@needs_slycot
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"effort": TransferFunction((0.0,), (1.0,))}, "D12 = 0"),
        ({"effort": TransferFunction((1.0,), (1.0, 1.0))}, "D12 = 0"),
        ({"effort": TransferFunction((1e-12,), (1.0,))}, "nearly singular"),
        ({"performance": TransferFunction((1.0, 300.0), (1.0, 0.0))}, "has the pole 0 rad/s"),
        ({"performance": TransferFunction((1.0, 300.0), (1.0, -2.0))}, "has the pole 2 rad/s"),
        ({"performance": TransferFunction((1.0, 300.0), (1.0, 1e-12))}, "is singular"),
        ({"performance": TransferFunction((1e6, 3e9), (1.0, 1.0))}, "below 10000"),
        ({"disturbance": TransferFunction((1e6,), (1.0,))}, "below 10000"),
    ],
)
def test_singular_and_infeasible_problems_are_explained(change, message):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(SynthesisError, match=message):
            synthesize(DesignProblem(weights=dataclasses.replace(REGULAR, **change)))


@settings(max_examples=25, deadline=60_000)
@given(
    effort=st.floats(-14, 3),
    disturbance=st.floats(-9, 6),
    bandwidth=st.floats(-2, 7),
    slow=st.floats(-12, 2),
)
def test_any_weights_end_in_a_controller_or_an_explanation(effort, disturbance, bandwidth, slow):
    # The deadline of a minute is the point: python-control's scan can take hours here.
    weights = Weights(
        performance=TransferFunction((0.5, 10.0**bandwidth), (1.0, 10.0**slow)),
        effort=TransferFunction((10.0**effort,), (1.0,)),
        disturbance=TransferFunction((10.0**disturbance,), (1.0,)),
    )
    try:
        design = synthesize(DesignProblem(weights=weights))
    except SynthesisError as error:
        assert len(str(error)) > 40
    else:
        assert design.gamma > 0.0


COEFFICIENTS = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=4).map(tuple)


@settings(max_examples=100)
@given(numerator=COEFFICIENTS, denominator=COEFFICIENTS)
@example(numerator=(0.3,), denominator=(1.0,))
@example(numerator=(0.0,), denominator=(1.0, 0.0))
@example(numerator=(1.0, 0.0), denominator=(1.0, 1.0, 0.0))  # s / (s (s + 1))
@example(numerator=(1.0, 2.0), denominator=(1.0, 2.0, 1.0))
def test_any_given_controller_ends_in_a_law_or_an_explanation(numerator, denominator):
    try:
        given = TransferFunction(numerator, denominator)
        law = synthesize(DesignProblem(method="given", controller=given)).controller
    except (ParameterError, SynthesisError) as error:
        assert len(str(error)) > 30
    else:
        assert np.all(np.isfinite([*law.a, *law.b, *law.c, *law.anti_windup]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "given"}, "'controller' must be given"),
        (
            {"method": "given", "controller": TransferFunction((0.3,), (1.0,))},
            r"'controller' is \(0.3,\) / \(1.0,\), must have .* a pole",
        ),
        (
            {"method": "given", "controller": TransferFunction((0.0,), (1.0, 0.0))},
            r"'controller' is \(0.0,\) / .* must have a numerator that is not 0",
        ),
        ({"method": "pid", "weights": REGULAR}, "'weights' are for method 'hinf'"),
    ],
)
def test_refuses_contradictory_problems(change, message):
    with pytest.raises(ParameterError, match=message):
        DesignProblem(**change)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FingerModel(denominator=(1.0, 1.0)), "three positive numbers"),
        (lambda: TransferFunction((1.0,), ()), "both or neither"),
        (lambda: TransferFunction((1.0, 1.0), (1.0,)), "proper"),
        (lambda: Weights(performance=CONSTANT), "all or none"),
    ],
)
def test_refuses_what_does_not_fit(make, message):
    with pytest.raises(ParameterError, match=message):
        make()


@pytest.mark.parametrize("method", ["given", "pid", "damped_integrator"])
def test_a_resonance_above_nyquist_is_named(method):
    """666.6 Hz + 20 % = 800 Hz, sampled at 1 kHz."""
    given = TransferFunction((1.0,), (1.0, 0.0)) if method == "given" else TransferFunction()
    finger = FingerModel(sample_time=1e-3)
    with pytest.raises(
        SynthesisError, match=r"up to (799.9|800) Hz .* Nyquist frequency of 500 Hz"
    ):
        synthesize(DesignProblem(method=method, controller=given, finger=finger))


def test_a_box_that_no_structure_keeps_stable_is_named(monkeypatch):
    """A finger whose gain may be anything up to 10000 times: any loop gain at 667 Hz is too much."""
    monkeypatch.setattr("piezo_control.design.synthesis.TUNING_EVALUATIONS", 30)
    p = DesignProblem(method="pid", uncertainty=Uncertainty(gain_low=0.01, gain_high=100.0))
    with pytest.raises(
        SynthesisError, match="no controller that is stable over the box: poles up to"
    ):
        synthesize(p)


def test_only_a_design_from_weights_needs_slycot(monkeypatch):
    monkeypatch.setitem(sys.modules, "slycot", None)  # as where it is not installed
    hinf.slicot.cache_clear()
    with pytest.raises(SynthesisError, match="'hinf' needs slycot .*pip install --no-deps slycot"):
        synthesize(problem("fast"))
    assert synthesize(problem("paper")).controller.order == 3
    hinf.slicot.cache_clear()
