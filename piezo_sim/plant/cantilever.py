# SPDX-License-Identifier: Apache-2.0
"""The piezocantilever: delta = H_s(U) D(s) + s_p F D(s) + g(T) + Creep(U, T)  (paper eq. 3-5).

Each term is a module of its own; this one composes them, in the order of one sample:

    amplifier -> hysteresis -> (+ tip force) -> vibration -> + g(T) + Creep -> sensor

Voltage, temperature and tip force are held from t_k to t_{k+1}. The finger starts at rest at 0 V, in
equilibrium with the first temperature, and deflections count from there, as after pressing the sensor's
zero key. So a run at constant 32 °C starts at zero (Fig. 13), and g(T) is what changes from then on.

Figures of the paper disagree: 40 V from rest end at about 30 µm in Fig. 4, at 22 µm in Fig. 5. On the
first rise from rest a Prandtl-Ishlinskii actuator reaches just the tip of its loop, so no weights give
both; a sensor zeroed at 0 V behind a negative excursion explains 26 of the 30 µm (the remanence is
4 µm). The default follows Fig. 5 in size, and Fig. 3 and 4 in their course over time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from piezo_control import creep, thermal
from piezo_control.creep import Creep, CreepParameters, creep_step
from piezo_control.dynamics import DynamicsParameters, ModesParameters, Motion
from piezo_control.hysteresis import (
    Coefficients,
    HysteresisParameters,
    State,
    at_rest,
    from_rest,
    operator_step,
)
from piezo_control.parameters import group, parameter
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.thermal import (
    REFERENCE_DEGC,
    Body,
    Thermal,
    ThermalParameters,
    heated,
    thermal_deflection,
    warm,
)
from piezo_sim.plant import amplifier, contact
from piezo_sim.plant.amplifier import Amplifier, AmplifierParameters, AmplifierState, amplify
from piezo_sim.plant.bouc_wen import BoucWen, BoucWenState, TruthParameters, bouc_wen_step
from piezo_sim.plant.contact import (
    ContactParameters,
    Tip,
    contact_force,
    move_tip,
    parts_of,
    tip_of,
)
from piezo_sim.plant.sensor import Sensor, SensorParameters, read

DRAWS_AT_ONCE = 4096


@dataclass(frozen=True)
class CantileverParameters:
    """Everything about the simulated cantilever."""

    plant: str = parameter(
        "prandtl_ishlinskii",
        "class of the hysteresis: that of the inverse, or the truth plant (Bouc-Wen, logarithmic creep)",
        choices=("prandtl_ishlinskii", "truth"),
    )
    sample_time: float = parameter(SAMPLE_TIME, "sample time", unit="s", low=1e-7, high=1.0)
    seed: int = parameter(1, "seed of the sensor's noise and drop-outs", low=0, high=2**63 - 1)
    hysteresis: HysteresisParameters = group(HysteresisParameters)
    dynamics: DynamicsParameters = group(DynamicsParameters)
    modes: ModesParameters = group(ModesParameters)
    creep: CreepParameters = group(CreepParameters)
    thermal: ThermalParameters = group(ThermalParameters)
    contact: ContactParameters = group(ContactParameters)
    sensor: SensorParameters = group(SensorParameters)
    amplifier: AmplifierParameters = group(AmplifierParameters)
    truth: TruthParameters = group(TruthParameters)


class CantileverModel(NamedTuple):
    """The terms of one sample of the cantilever, in their order."""

    amplifier: Amplifier
    is_truth: bool  # which of the next two is H_s
    operator: Coefficients
    bouc_wen: BoucWen
    thermal: Thermal
    creep: Creep
    tip: Tip
    sensor: Sensor


class CantileverState(NamedTuple):
    """What the terms remember, changed in place: lists (or float64 arrays), of one where one number."""

    amplifier: AmplifierState
    hysteresis: State
    bouc_wen: BoucWenState
    body: Body
    relaxations: list[float]  # m
    motion: Motion
    tip_force: list[float]  # external and contact force (N)
    readings: list[float]  # m, the next to come out first


def model(parameters: CantileverParameters) -> CantileverModel:
    """Return the sampled model of the cantilever."""
    p = parameters
    h = p.sample_time
    operator = from_rest(p.hysteresis, h)
    bouc_wen = BoucWen(p.truth.slope, p.truth.alpha, p.truth.beta, p.truth.gamma)
    is_truth = p.plant == "truth"
    if is_truth:
        slope = bouc_wen.slope
        per_neper = slope / math.log(10.0)
        gain = p.truth.creep_per_decade * per_neper
        gain_per_degc = p.truth.creep_per_decade_degc * per_neper
        times, shares = creep.logarithmic(p.truth.creep_onset, p.truth.creep_last)
    else:
        slope = sum(p.hysteresis.weights)
        gain, gain_per_degc = p.creep.gain, p.creep.gain_per_degc
        times, shares = np.array(p.creep.times), np.array(p.creep.shares)
    return CantileverModel(
        amplifier=amplifier.discretize(p.amplifier, h),
        is_truth=is_truth,
        operator=operator,
        bouc_wen=bouc_wen,
        thermal=thermal.discretize(p.thermal, slope, h),
        creep=creep.discretize(gain, gain_per_degc, times, shares, h),
        tip=contact.discretize(p.contact, p.dynamics, p.modes, h),
        sensor=Sensor(p.sensor.resolution, p.sensor.noise, p.sensor.dropout_rate),
    )


def deviating(
    m: CantileverModel, resonance: float, damping: float, stroke: float
) -> CantileverModel:
    """Return the model with these factors on resonance, damping ratio and H_s.

    Creep keeps its size, higher modes stay where they are.
    """
    heat = m.thermal
    tip = m.tip
    a2 = tip.a2 / resonance**2
    parts = tip.parts  # which the propagators of higher modes are for
    if len(tip.higher) == 0:
        parts = parts_of(a2, tip.elastic_constant, tip.stiffness, tip.sample_time)
    return CantileverModel(
        m.amplifier,
        m.is_truth,
        m.operator,
        m.bouc_wen,
        Thermal(
            heat.slope,
            heat.stroke * stroke,
            heat.gain_per_degc,
            heat.lag_per_degc,
            heat.sensitivity,
            heat.retained,
        ),
        m.creep,
        tip_of(
            a2,
            tip.a1 * damping / resonance,
            tip.elastic_constant,
            tip.stiffness,
            tip.damping,
            tip.free_play,
            tip.sample_time,
            parts,
            tip.shares,
            tip.higher,
        ),
        m.sensor,
    )


def rest(m: CantileverModel, delay_samples: int, temperature_degc: float) -> CantileverState:
    """Return the state of a homed finger at its rest voltage, in equilibrium with `temperature_degc`.

    It was led there a moment ago, at 22 °C: nothing has crept yet.
    """
    voltage = m.amplifier.rest
    state = CantileverState(
        amplifier=AmplifierState(voltage=[voltage], clipped=[0.0]),
        hysteresis=at_rest(m.operator),
        bouc_wen=BoucWenState(lag=[0.0], voltage=[0.0]),
        body=Body([temperature_degc], degc_at_start=[temperature_degc]),
        relaxations=[0.0] * len(m.creep.retained),
        motion=Motion(x=[0.0] * len(m.tip.shares), v=[0.0] * len(m.tip.shares)),
        tip_force=[0.0],
        readings=[0.0] * (delay_samples + 1),
    )
    deflection = hysteresis_step(m, state, voltage)
    state.motion.x[:] = [share * deflection for share in m.tip.shares]
    state.readings[:] = [deflection] * len(state.readings)
    return state


def deflection_of(m: CantileverModel, s: CantileverState) -> float:
    """Return the true deflection (m) from the position of a homed finger at 0 V."""
    total = s.motion.x[0] + thermal_deflection(m.thermal, s.body)
    for i in range(1, len(s.motion.x)):
        total += s.motion.x[i]
    for i in range(len(s.relaxations)):
        total += s.relaxations[i]
    return total


def look(m: CantileverModel, s: CantileverState, normal: float, uniform: float) -> None:
    """Let the sensor take its reading of the present instant; s.readings[0] is what comes out."""
    read(s.readings, m.sensor, deflection_of(m, s), normal, uniform)


def hysteresis_step(m: CantileverModel, s: CantileverState, voltage: float) -> float:
    """Return H_s(U) (m) of the class of plant that was chosen."""
    if m.is_truth:
        return bouc_wen_step(m.bouc_wen, s.bouc_wen, voltage)
    return operator_step(m.operator, s.hysteresis, voltage)


def advance(
    m: CantileverModel, s: CantileverState, demand: float, temperature_degc: float, force: float
) -> None:
    """Go from t_k to t_{k+1} with the demanded voltage (V), temperature (°C) and tip force (N)."""
    voltage = amplify(s.amplifier, m.amplifier, demand)
    warmth = s.body.degc[0] - REFERENCE_DEGC
    actuated = heated(m.thermal, hysteresis_step(m, s, voltage), voltage, warmth)
    elastic = m.tip.elastic_constant * force
    crept = creep_step(m.creep, s.relaxations, voltage, warmth)
    warm(m.thermal, s.body, temperature_degc)
    drift = thermal_deflection(m.thermal, s.body) + crept
    move_tip(s.motion, m.tip, actuated + elastic, drift)
    for i in range(1, len(s.motion.x)):
        drift += s.motion.x[i]
    s.tip_force[0] = force + contact_force(m.tip, s.motion.x[0] + drift, s.motion.v[0])


class Cantilever:
    """The simulated cantilever, sample by sample.

    Per sample k: ``measure()`` is what the sensor says at t_k, then ``advance()`` goes to t_{k+1}.
    """

    def __init__(self, parameters: CantileverParameters) -> None:
        self.parameters = parameters
        self._model = model(parameters)
        self.reset()

    def reset(self) -> None:
        """Go back to sample 0: homed and at rest, random draws from the seed."""
        self._state = rest(self._model, self.parameters.sensor.delay_samples, REFERENCE_DEGC)
        self._generators = generators(self.parameters.seed)
        self._draws: Iterator[tuple[float, float]] = iter(())
        self.samples = 0
        self._look()

    def measure(self) -> float:
        """Return the sensor's output at the present instant (m); asking again changes nothing."""
        return self._state.readings[0]

    def advance(self, voltage: float, temperature_degc: float, tip_force: float = 0.0) -> None:
        """Go on by one sample with these inputs held: V, °C, N (external force on the tip).

        The first temperature is the one the finger starts in equilibrium with.

        Raises ValueError, naming input and sample, for NaN or infinity; the state stays as it was.
        """
        for name, value, unit in (
            ("voltage", voltage, "V"),
            ("temperature_degc", temperature_degc, "°C"),
            ("tip_force", tip_force, "N"),
        ):
            if not math.isfinite(value):
                raise ValueError(
                    f"{name} is {value} {unit} at sample {self.samples}, must be a finite number"
                )
        if self.samples == 0:
            self._state.body.degc[0] = self._state.body.degc_at_start[0] = temperature_degc
        advance(self._model, self._state, voltage, temperature_degc, tip_force)
        self.samples += 1
        self._look()

    @property
    def deflection(self) -> float:
        """True deflection (m) from the position of a homed finger at 0 V."""
        return deflection_of(self._model, self._state)

    @property
    def voltage(self) -> float:
        """Voltage as applied by the amplifier (V)."""
        return self._state.amplifier.voltage[0]

    @property
    def tip_force(self) -> float:
        """Force on the tip (N), external and contact, at the present instant."""
        return self._state.tip_force[0]

    @property
    def body_degc(self) -> float:
        """Temperature of the cantilever's body (°C)."""
        return self._state.body.degc[0]

    @property
    def clipped(self) -> int:
        """Number of samples whose demanded voltage the amplifier clipped."""
        return int(self._state.amplifier.clipped[0])

    def _look(self) -> None:
        draw = next(self._draws, None)
        if draw is None:
            self._draws = iter(list(zip(*draws(self._generators, DRAWS_AT_ONCE))))
            draw = next(self._draws)
        look(self._model, self._state, *draw)


def generators(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Return the generators of the sensor's noise and of its drop-outs."""
    stream = np.random.PCG64(seed)
    return np.random.Generator(stream), np.random.Generator(stream.jumped())


def draws(
    sources: tuple[np.random.Generator, np.random.Generator], count: int
) -> tuple[list[float], list[float]]:
    """Return the draws of the next `count` readings: standard normal and uniform."""
    return sources[0].standard_normal(count).tolist(), sources[1].random(count).tolist()
