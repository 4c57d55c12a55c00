# SPDX-License-Identifier: Apache-2.0
"""Judge a controller by its closed loop alone: nothing a solver said is believed.

Takes the coefficients of the feedback law and the design problem, closes the sampled loop around
every finger of the uncertainty box and recomputes stability, sensitivity peaks, margins, step
responses and the norms the weights ask about. :func:`certify` compares them with the specifications.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np

from piezo_control.design.linear_loop import (
    ClosedLoop,
    Fingers,
    Margins,
    closed_loop,
    controller_response,
    finger_response,
    fingers,
    frequency_grid,
    held_voltage,
    margins,
    noise_gain,
    respond,
    settling,
    spectral_radius,
    static_gain,
)
from piezo_control.design.problem import DesignProblem, TransferFunction
from piezo_control.design.robustness import Proof, prove, unmodelled_weight
from piezo_control.feedback import FeedbackParameters

STEP_BAND = 0.05
RECORD_SETTLING_TIMES = 4.0
DRIFT_STEP_DEGC = 10.0
UNSTABLE = 1e3
"""Cost, times the spectral radius, of a controller that is not stable over the box."""
PARTS = 8
PROOF_SLACK = 1.01
"""The first bound to be tried is so much above what the samples have."""
BOUNDS = 6
"""Bounds to be tried, from there to what is required."""
GAMMA_AGREEMENT = 1.05
"""The recomputed norm may exceed the solver's gamma by this factor, for truncation and integrator."""


class Figures(NamedTuple):
    """Figures of every finger of a box, arrays with shape (nfingers,); infinite when unstable.

    `settling`, `overshoot` and `static_error` belong to a reference step; the peaks are those of |S|,
    |T|, |K S| and |G S|; `force_settling` is how long a force step leaves more than 5 % of its open-loop
    static deflection (s), `drift` the largest deflection after a temperature step (m/°C). `noise_gain` is
    the command's scatter per scatter of the readings, `unmodelled` the peak of |K S| W, below 1 when every
    mode that nobody modelled leaves the loop stable.
    """

    settling: np.ndarray
    overshoot: np.ndarray
    static_error: np.ndarray
    sensitivity_peak: np.ndarray
    complementary_peak: np.ndarray
    effort_peak: np.ndarray
    disturbance_peak: np.ndarray
    force_settling: np.ndarray
    drift: np.ndarray
    noise_gain: np.ndarray
    unmodelled: np.ndarray


class Box:
    """The uncertainty box of a problem, sampled; prepared once for many controllers.

    `resonance`, `damping` and `gain` are the numbers of values along each side (odd; the middle one is
    nominal), `points` that of frequencies. `spread` replaces the problem's relative range of the resonance.
    """

    def __init__(
        self,
        problem: DesignProblem,
        resonance: int,
        damping: int,
        gain: int,
        points: int,
        spread: float | None = None,
    ) -> None:
        self.problem = problem
        self.fingers = _sample_box(problem, resonance, damping, gain, spread)
        self.sides = (resonance, damping, gain, spread)
        self.outer = _sample_box(
            problem, 2 * resonance - 1, 3, 3, problem.uncertainty.resonance_stable
        )
        step = problem.finger.sample_time
        omega = 1.0 / math.sqrt(problem.finger.denominator[0])
        reach = problem.uncertainty.resonance_stable + 0.05
        self.frequency = frequency_grid(step, (1 - reach) * omega, (1 + reach) * omega, points)
        self.z = np.exp(1j * self.frequency * step)
        self.plant = finger_response(self.fingers, self.z)
        self.weight = unmodelled_weight(problem, self.frequency * step)
        self.samples = math.ceil(RECORD_SETTLING_TIMES * problem.specification.settling_time / step)

    def radius(self, controller: FeedbackParameters) -> tuple[np.ndarray, np.ndarray]:
        """Return the spectral radii of the box and of the wider one that has to be stable."""
        return (
            spectral_radius(closed_loop(self.fingers, controller)),
            spectral_radius(closed_loop(self.outer, controller)),
        )

    def figures(self, controller: FeedbackParameters) -> Figures:
        """Return the figures of all fingers of the box."""
        loop = closed_loop(self.fingers, controller)
        unstable = spectral_radius(loop) >= 1.0
        feedback, _ = controller_response(controller, self.z)
        sensitivity = 1.0 / (1.0 + feedback * self.plant)
        with np.errstate(over="ignore", invalid="ignore"):
            step = self.step_responses(loop)
            force = respond(loop, "force", self.samples)
            values = Figures(
                settling=settling(step, self.fingers.sample_time, 1.0, STEP_BAND),
                overshoot=np.maximum(step.max(axis=1) - 1.0, 0.0),
                static_error=np.abs(1.0 - static_gain(loop)),
                sensitivity_peak=np.abs(sensitivity).max(axis=1),
                complementary_peak=np.abs(1.0 - sensitivity).max(axis=1),
                effort_peak=np.abs(feedback * sensitivity).max(axis=1),
                disturbance_peak=np.abs(self.plant * sensitivity).max(axis=1),
                force_settling=settling(force, self.fingers.sample_time, 0.0, STEP_BAND),
                drift=self.drift(loop),
                noise_gain=noise_gain(loop),
                unmodelled=np.abs(feedback * sensitivity * self.weight).max(axis=1),
            )
        return Figures(*(np.where(unstable, np.inf, value) for value in values))

    def step_responses(self, loop: ClosedLoop) -> np.ndarray:
        """Return the readings after a unit step of the reference, shape (nfingers, nsamples)."""
        return respond(loop, "reference", self.samples)

    def intersample(self, controller: FeedbackParameters) -> np.ndarray:
        """Return the overshoot of the tip itself after a step, between samples too: PARTS times a sample."""
        loop = closed_loop(self.fingers, controller)
        h = self.problem.finger.sample_time
        states, voltage = held_voltage(self.fingers, loop, self.samples)
        peak = states[:, 0::2].sum(axis=1).max(axis=1)
        for part in range(1, PARTS):
            finger = replace(self.problem.finger, sample_time=part / PARTS * h)
            finer = _sample_box(replace(self.problem, finger=finger), *self.sides)
            between = np.einsum("nmij,nmjk->nmik", finer.a, states.reshape(*finer.b.shape, -1))
            tip = between[:, :, 0].sum(axis=1) + finer.b[:, :, 0].sum(axis=1)[:, None] * voltage
            peak = np.maximum(peak, tip.max(axis=1))
        return np.maximum(peak - 1.0, 0.0)

    def drift(self, loop: ClosedLoop) -> np.ndarray:
        """Return the largest deflection per degree (m/°C) after a step of the temperature.

        The tip drifts away with the lag of the body. The loop is so much faster that the largest
        deflection comes while the drift is nearly a ramp, within the record, or, of a loop that does not integrate,
        at the end: from the one to the other what is left follows the lag.
        """
        model = self.problem.finger
        readings = respond(
            loop, "drift", self.samples, model.drift_time_constant, model.sample_time
        )
        at_the_end = np.abs(static_gain(loop, "drift"))
        return model.drift_per_degc * np.maximum(np.abs(readings).max(axis=1), at_the_end)

    def cost(self, controller: FeedbackParameters, reserve: float) -> float:
        """Return what tuning minimises: relative settling time plus penalties.

        A figure counts as exceeding its specification from `reserve` (< 1) of it on. Unstable boxes
        cost more than stable ones, more so the more unstable they are.
        """
        radius = max(part.max() for part in self.radius(controller))
        if not radius < 1.0:
            return UNSTABLE * min(radius, 100.0)
        worst = {
            name: float(value.max()) for name, value in self.figures(controller)._asdict().items()
        }
        cost = min(worst["settling"] / self.problem.specification.settling_time, 100.0)
        for name, required in _required(self.problem).items():
            if required > 0.0:
                cost += 10.0 * min(max(worst[name] / (reserve * required) - 1.0, 0.0), 10.0)
        return cost


def _required(problem: DesignProblem) -> dict[str, float]:
    """Return {figure: largest allowed value}; 0 is not asked for."""
    s = problem.specification
    return {
        "settling": s.settling_time,
        "overshoot": s.overshoot,
        "static_error": s.static_error,
        "sensitivity_peak": s.sensitivity_peak,
        "effort_peak": s.effort_peak,
        "force_settling": s.force_settling_time,
        "drift": s.drift_per_degc,
        "noise_gain": s.noise_gain,
        "unmodelled": 1.0 if problem.uncertainty.unmodelled_share else 0.0,
    }


def _sample_box(
    problem: DesignProblem, resonance: int, damping: int, gain: int, spread: float | None
) -> Fingers:
    u = problem.uncertainty
    spread = u.resonance if spread is None else spread
    return fingers(
        problem.finger,
        _around_one(1.0 - spread, 1.0 + spread, resonance),
        _around_one(u.damping_low, u.damping_high, damping),
        _around_one(u.gain_low, u.gain_high, gain),
    )


def _around_one(low: float, high: float, count: int) -> np.ndarray:
    """Return an odd number of factors from `low` to `high`, the middle one being 1."""
    half = count // 2 + 1
    return np.concatenate([np.geomspace(low, 1.0, half), np.geomspace(1.0, high, half)[1:]])


# Norms ----------------------------------------------------------------------------------------


def transfer_response(transfer: TransferFunction, s: np.ndarray) -> np.ndarray:
    """Return a transfer function's values at `s` (rad/s)."""
    return np.polyval(transfer.numerator, s) / np.polyval(transfer.denominator, s)


def weighted_norms(problem: DesignProblem, controller: FeedbackParameters) -> dict[str, float]:
    """Return the H-infinity norms of the nominal closed loop against each weight, and of all four.

    The generalised plant's closed loop is the product of a column, a scalar and a row,

        [Ws; Wu K] S [1, -G Wd],

    so its largest singular value at each frequency is the product of their lengths. The bilinear
    transform keeps norms: weights are read at the w-plane frequency. The frequency grid is refined
    around the maximum. All are infinite when the loop is unstable.
    """
    names = ("performance", "performance_disturbance", "effort", "effort_disturbance", "all")
    model = problem.finger
    nominal = fingers(model)
    if spectral_radius(closed_loop(nominal, controller))[0] >= 1.0:
        return dict.fromkeys(names, math.inf)

    def responses(frequency: np.ndarray) -> np.ndarray:
        z = np.exp(1j * frequency * model.sample_time)
        w = 2j / model.sample_time * np.tan(0.5 * frequency * model.sample_time)
        plant = finger_response(nominal, z)[0]
        feedback, _ = controller_response(controller, z)
        sensitivity = 1.0 / np.abs(1.0 + feedback * plant)
        performance = np.abs(transfer_response(problem.weights.performance, w)) * sensitivity
        effort = np.abs(transfer_response(problem.weights.effort, w) * feedback) * sensitivity
        through = np.abs(plant * transfer_response(problem.weights.disturbance, w))
        whole = np.hypot(performance, effort) * np.hypot(1.0, through)
        return np.array([performance, performance * through, effort, effort * through, whole])

    omega = 1.0 / math.sqrt(model.denominator[0])
    grid = frequency_grid(model.sample_time, 0.5 * omega, 1.5 * omega, 4000)
    # tan is infinite at the Nyquist frequency itself; 1e-9 below it nothing differs any more.
    grid = np.concatenate(
        [grid[0] * np.geomspace(1e-6, 0.9, 200), grid[:-1], grid[-1:] * (1 - 1e-9)]
    )
    values = responses(grid)
    norms = {}
    for row, name in enumerate(names):
        peak = int(np.argmax(values[row]))
        fine = np.linspace(grid[max(peak - 1, 0)], grid[min(peak + 1, grid.size - 1)], 1001)
        norms[name] = float(max(values[row].max(), responses(fine)[row].max()))
    return norms


# Certificate ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One line of the table.

    `nominal` and `worst` are in `unit` and stand in `relation` to what is `required`; `at` says which
    finger is the worst.
    """

    specification: str
    unit: str
    required: float
    nominal: float
    worst: float
    at: str
    met: bool
    relation: str = "≤"


@dataclass(frozen=True)
class Certificate:
    """All that was recomputed; `met` when every row is."""

    name: str
    rows: tuple[Row, ...]
    nominal: dict[str, float]
    worst: dict[str, float]
    outer: dict[str, float]
    norms: dict[str, float]
    gamma: float

    @property
    def met(self) -> bool:
        """True when every specification is met and the solver's gamma confirmed."""
        return all(row.met for row in self.rows)

    def as_dict(self) -> dict:
        """Return everything as plain data."""
        return {**asdict(self), "met": self.met}


_LABELS = {
    "settling": ("settling into 5 %", "ms", 1e3),
    "overshoot": ("overshoot", "%", 100.0),
    "static_error": ("static error", "%", 100.0),
    "sensitivity_peak": ("sensitivity peak Ms", "", 1.0),
    "effort_peak": ("effort peak |K S|", "", 1.0),
    "force_settling": ("force step down to 5 %", "ms", 1e3),
    "drift": ("drift after a temperature step", "µm/10 °C", 1e6 * DRIFT_STEP_DEGC),
    "noise_gain": ("noise gain, readings to command", "", 1.0),
    "unmodelled": ("unmodelled modes, |K S| W", "", 1.0),
}


def certify(
    problem: DesignProblem, controller: FeedbackParameters, gamma: float = math.nan
) -> Certificate:
    """Recompute all figures of `controller` and compare them with the specifications of `problem`.

    `gamma` is the solver's claim about the problem's weights; NaN when there is none. It is
    confirmed when the recomputed norm is neither above it nor, beyond the problem's margin, below.
    """
    box = Box(problem, resonance=9, damping=5, gain=3, points=1200)
    centre = len(box.fingers.a) // 2
    inner, outer = box.radius(controller)
    own = abs(np.linalg.eigvals(controller.matrix("a"))).max(initial=0.0)
    figures = box.figures(controller)
    rows = [
        _stability_row("poles of the loop", box.fingers, inner),
        _stability_row("poles with resonance further off", box.outer, outer),
        Row(
            "poles of the controller", "", 1.0, float(own), float(own), "", bool(own <= 1.0 + 1e-9)
        ),
    ]
    for name, required in _required(problem).items():
        label, unit, scale = _LABELS[name]
        value = getattr(figures, name)
        worst = int(np.argmax(value))
        if required > 0.0:
            rows.append(
                Row(
                    label,
                    unit,
                    required * scale,
                    float(value[centre] * scale),
                    float(value[worst] * scale),
                    _describe(box.fingers, worst),
                    bool(value[worst] <= required),
                )
            )
    far = Box(problem, 9, 3, 3, 1200, problem.uncertainty.resonance_stable).figures(controller)
    rows += _proven_rows(problem, controller, figures, far)
    norms: dict[str, float] = {}
    if problem.weights:
        norms = weighted_norms(problem, controller)
        rows.append(_gamma_row(problem, gamma, norms["all"]))
    all_margins = box_margins(box, controller)
    with np.errstate(over="ignore", invalid="ignore"):
        between = box.intersample(controller)
    return Certificate(
        name=controller.name,
        rows=tuple(rows),
        nominal={
            **{name: float(value[centre]) for name, value in figures._asdict().items()},
            **all_margins[centre]._asdict(),
            "intersample": float(between[centre]),
            **nominal_figures(problem, controller),
        },
        worst={
            **{name: float(value.max()) for name, value in figures._asdict().items()},
            "intersample": float(between.max()),
            "gain_up": min(m.gain_up for m in all_margins),
            "gain_down": max(m.gain_down for m in all_margins),
            "phase_deg": min(m.phase_deg for m in all_margins),
            "delay_s": min(m.delay_s for m in all_margins),
        },
        outer={name: float(value.max()) for name, value in far._asdict().items()},
        norms=norms,
        gamma=gamma,
    )


def _describe(box: Fingers, index: int) -> str:
    change = box.resonance[index] - 1.0
    return (
        f"resonance {100 * change:+.3g} %, damping x{box.damping[index]:.3g}, "
        f"gain {100 * (box.gain[index] - 1.0):+.3g} %"
    )


def _stability_row(label: str, box: Fingers, radius: np.ndarray) -> Row:
    worst = int(np.argmax(radius))
    nominal = float(radius[len(radius) // 2])
    is_stable = bool(radius[worst] < 1.0)
    return Row(label, "", 1.0, nominal, float(radius[worst]), _describe(box, worst), is_stable, "<")


def _proven_rows(
    problem: DesignProblem, controller: FeedbackParameters, inner: Figures, outer: Figures
) -> list[Row]:
    """Return what holds for every finger of the continuous box, by a bound and not by samples."""
    u, allowed = problem.uncertainty, problem.specification.sensitivity_peak
    return [
        _proven_row(
            "proven: |K S| W, continuous box, resonance further off",
            float(outer.unmodelled.max()),
            1.0,
            lambda bound: prove(problem, controller, u.resonance_stable, unmodelled=1.0 / bound),
        ),
        _proven_row(
            "proven: sensitivity peak Ms, continuous box",
            float(inner.sensitivity_peak.max()),
            allowed,
            lambda bound: prove(problem, controller, u.resonance, smallest=1.0 / bound),
        ),
    ]


def _proven_row(
    label: str, sampled: float, required: float, claim: Callable[[float], Proof]
) -> Row:
    """Return the lowest bound, between what the samples have and what is required, that is proven."""
    proof = Proof(False, 0, "the samples have more than is required")
    if sampled < required:
        lowest = min(PROOF_SLACK * max(sampled, 0.01), required)
        for bound in np.geomspace(lowest, required, BOUNDS):
            proof = claim(float(bound))
            if proof.holds:
                return Row(label, "", required, float(bound), float(bound), "every finger", True)
    return Row(label, "", required, math.inf, math.inf, proof.why, False)


def _gamma_row(problem: DesignProblem, gamma: float, norm: float) -> Row:
    low = gamma / (GAMMA_AGREEMENT * problem.gamma_margin)
    is_confirmed = low <= norm <= GAMMA_AGREEMENT * gamma
    return Row(
        "weighted norm is the solver's gamma", "", gamma, norm, norm, "nominal", is_confirmed, "≈"
    )


def box_margins(box: Box, controller: FeedbackParameters) -> list[Margins]:
    """Return the margins of every finger of the box (meaningful where the loop is stable)."""
    feedback, _ = controller_response(controller, box.z)
    return [margins(box.frequency, feedback * plant) for plant in box.plant]


def nominal_figures(problem: DesignProblem, controller: FeedbackParameters) -> dict[str, float]:
    """Return what only the nominal loop is asked for.

    ``bandwidth`` is where the response from reference to reading falls below -3 dB of its static
    value for the first time (rad/s), ``sensitivity_static`` is S(1), ``settling_2`` the settling time
    into 2 %, ``settling_final`` that into 5 % around the final value. ``feedback_above`` is the largest
    |K| from `unmodelled_from_hz` on. ``resonance_low`` and
    ``resonance_high`` are the factors on the resonance between which the loop is stable, in steps
    of 0.005 and within 0.4 to 1.6.
    """
    model = problem.finger
    nominal = fingers(model)
    omega = 1.0 / math.sqrt(model.denominator[0])
    frequency = frequency_grid(model.sample_time, 0.8 * omega, 1.2 * omega, 8000)
    z = np.exp(1j * frequency * model.sample_time)
    plant = finger_response(nominal, z)[0]
    feedback, reference = controller_response(controller, z)
    sensitivity = 1.0 / (1.0 + feedback * plant)
    tracking = np.abs((feedback + reference) * plant * sensitivity)
    loop = closed_loop(nominal, controller)
    final = float(static_gain(loop)[0])
    below = np.flatnonzero(tracking < abs(final) / math.sqrt(2.0))
    samples = math.ceil(
        2.0 * RECORD_SETTLING_TIMES * problem.specification.settling_time / model.sample_time
    )
    with np.errstate(over="ignore", invalid="ignore"):
        step = respond(loop, "reference", samples)
    above = frequency >= 2.0 * math.pi * problem.uncertainty.unmodelled_from_hz
    low, high = stable_resonances(problem, controller)
    return {
        "bandwidth": float(frequency[below[0]]) if below.size else math.inf,
        "sensitivity_static": abs(1.0 - final),
        "settling_2": float(settling(step, model.sample_time, 1.0, 0.02)[0]),
        "settling_final": float(settling(step, model.sample_time, final, 0.05 * abs(final))[0]),
        "feedback_above": float(np.abs(feedback[above]).max(initial=0.0)),
        "resonance_low": low,
        "resonance_high": high,
    }


def stable_resonances(
    problem: DesignProblem, controller: FeedbackParameters
) -> tuple[float, float]:
    """Return the lowest and highest factor on the resonance up to which the loop stays stable.

    From 1 outwards in steps of 0.005, within 0.4 to 1.6, nominal damping and gain; NaN when the
    nominal loop is unstable.
    """
    model = problem.finger
    factors = np.arange(80, 321) * 0.005
    box = fingers(model, resonance=factors)
    unstable = np.flatnonzero(spectral_radius(closed_loop(box, controller)) >= 1.0)
    centre = 120
    if centre in unstable:
        return math.nan, math.nan
    below, above = unstable[unstable < centre], unstable[unstable > centre]
    low = factors[below[-1] + 1] if below.size else factors[0]
    high = factors[above[0] - 1] if above.size else factors[-1]
    return float(low), float(high)
