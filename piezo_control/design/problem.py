# SPDX-License-Identifier: Apache-2.0
"""What `synthesize` is asked for: finger, uncertainty, specifications, and how to design.

The same declarations read the YAML (layout of a ROS parameter file, node name `synthesize`).
"""

from __future__ import annotations

from dataclasses import dataclass

from piezo_control.dynamics import DynamicsParameters, ModesParameters
from piezo_control.hysteresis import REACH
from piezo_control.parameters import ParameterError, group, parameter
from piezo_control.sequence import SAMPLE_TIME

METHODS = (
    "hinf", "given", "damped_integrator", "model_following", "pid", "integrator_notch",
)  # fmt: skip


class SynthesisError(ValueError):
    """A design problem without a solution; the message says why."""


@dataclass(frozen=True)
class FingerModel:
    """The linear finger: D(s), amplifier, sensor delay, reachable range and slow disturbances."""

    denominator: tuple[float, ...] = parameter(
        DynamicsParameters().denominator,
        "denominator of D(s), highest power first; D(0) = 1",
        low=0.0,
    )
    modes: ModesParameters = group(ModesParameters)
    sample_time: float = parameter(
        SAMPLE_TIME, "sample time of the loop", unit="s", low=1e-6, high=0.1
    )
    amplifier_bandwidth_hz: float = parameter(
        0.0,
        "cut-off of the amplifier's first-order lag; 0: unlimited",
        unit="Hz",
        low=0.0,
        high=1e9,
    )
    delay_samples: int = parameter(1, "samples from deflection to reading", low=0, high=10)
    command_low: float = parameter(REACH[0], "lowest reachable deflection", unit="m")
    command_high: float = parameter(REACH[1], "highest reachable deflection", unit="m")
    drift_per_degc: float = parameter(
        2.7e-7,
        "open-loop deflection per degree: thermal offset, and change of the stroke at full deflection",
        unit="m/degC",
        low=0.0,
    )
    drift_time_constant: float = parameter(
        0.3, "lag of that deflection behind the temperature; 0: none", unit="s", low=0.0, high=1e4
    )

    def __post_init__(self) -> None:
        d = self.denominator
        if len(d) != 3 or d[2] != 1.0 or min(d) <= 0.0:
            raise ParameterError(
                f"'denominator' is {d}, must be three positive numbers, the last 1.0"
            )


@dataclass(frozen=True)
class Uncertainty:
    """The box of fingers for which the specifications have to hold."""

    resonance: float = parameter(0.1, "relative, to both sides", low=0.0, high=0.9)
    resonance_stable: float = parameter(
        0.2, "the same, within which the loop has to stay stable", low=0.0, high=0.9
    )
    damping_low: float = parameter(0.5, "smallest factor on the damping ratio", low=0.01, high=1.0)
    damping_high: float = parameter(2.0, "largest factor on the damping ratio", low=1.0, high=100.0)
    gain_low: float = parameter(0.9, "smallest factor on the loop gain", low=0.01, high=1.0)
    gain_high: float = parameter(1.1, "largest factor on the loop gain", low=1.0, high=100.0)
    temperature_undone: bool = parameter(
        False,
        "the range of the gain leaves out what the temperature does to the stroke: the feedforward undoes "
        "that, `compensator: sensorless`",
    )
    unmodelled_share: float = parameter(
        0.0,
        "static share, of either sign, of a mode that nobody modelled; the loop has to stay stable",
        low=0.0,
        high=0.9,
    )
    unmodelled_from_hz: float = parameter(
        2000.0, "such a mode lies anywhere from here on", unit="Hz", low=1.0, high=1e6
    )
    unmodelled_damping: float = parameter(0.017, "its smallest damping ratio", low=1e-3, high=0.5)

    def __post_init__(self) -> None:
        if self.resonance_stable < self.resonance:
            raise ParameterError(
                f"'resonance_stable' is {self.resonance_stable}, must be at least "
                f"'resonance' ({self.resonance})"
            )


@dataclass(frozen=True)
class Specification:
    """What the closed loop has to do, at every finger of the box; step responses are readings."""

    settling_time: float = parameter(
        0.010, "response to a reference step, into 5 % of the step around it", unit="s", low=1e-5
    )
    overshoot: float = parameter(0.005, "of the step", low=1e-4, high=10.0)
    static_error: float = parameter(0.0005, "of the step", low=0.0, high=1.0)
    sensitivity_peak: float = parameter(1.6, "largest |S|", low=1.01, high=100.0)
    effort_peak: float = parameter(4.0, "largest |K S|: command per reading", low=0.1, high=1e4)
    noise_gain: float = parameter(
        0.0, "scatter of the command per scatter of the readings; 0: any", low=0.0, high=100.0
    )
    drift_per_degc: float = parameter(
        5e-8, "deflection per degree of a temperature step, at any moment", unit="m/degC", low=0.0
    )
    force_settling_time: float = parameter(
        0.0,
        "after a force step, until 5 % of its open-loop static deflection is left; 0: any",
        unit="s",
        low=0.0,
    )


@dataclass(frozen=True)
class TransferFunction:
    """A transfer function in s (rad/s); empty: not given."""

    numerator: tuple[float, ...] = parameter((), "coefficients, highest power first")
    denominator: tuple[float, ...] = parameter((), "coefficients, highest power first")

    def __post_init__(self) -> None:
        if bool(self.numerator) != bool(self.denominator):
            raise ParameterError("'numerator' and 'denominator' must be given both or neither")
        if len(self.numerator) > len(self.denominator):
            raise ParameterError(
                f"'numerator' has {len(self.numerator)} coefficients, must have at most "
                f"{len(self.denominator)}, like 'denominator' (proper)"
            )
        if self.denominator and self.denominator[0] == 0.0:
            raise ParameterError("'denominator[0]' is 0.0, must not be")

    def __bool__(self) -> bool:
        return bool(self.numerator)


@dataclass(frozen=True)
class Weights:
    """Weights of the H-infinity problem; all left out: found from the specifications."""

    performance: TransferFunction = group(TransferFunction)
    effort: TransferFunction = group(TransferFunction)
    disturbance: TransferFunction = group(TransferFunction)

    def __post_init__(self) -> None:
        given = [bool(w) for w in (self.performance, self.effort, self.disturbance)]
        if any(given) != all(given):
            raise ParameterError(
                "'performance', 'effort' and 'disturbance' must be given all or none"
            )

    def __bool__(self) -> bool:
        return bool(self.performance)


@dataclass(frozen=True)
class Prefilter:
    """Low-pass between reference and loop, of second order, or of third with `pole`; frequency 0: none."""

    frequency: float = parameter(0.0, "natural frequency", unit="rad/s", low=0.0, high=1e7)
    damping: float = parameter(0.7, "damping ratio", low=0.1, high=10.0)
    pole: float = parameter(0.0, "third pole, real; 0: none", unit="rad/s", low=0.0, high=1e7)


@dataclass(frozen=True)
class DesignProblem:
    """Everything `synthesize` reads from a YAML file."""

    name: str = parameter("custom", "name of the controller")
    method: str = parameter(
        "hinf",
        "'hinf': from the weights; 'given': `controller`, discretised; "
        "'damped_integrator', 'model_following', 'pid', 'integrator_notch': that structure, tuned to the "
        "specifications",
        choices=METHODS,
    )
    finger: FingerModel = group(FingerModel)
    uncertainty: Uncertainty = group(Uncertainty)
    specification: Specification = group(Specification)
    weights: Weights = group(Weights)
    gamma_margin: float = parameter(
        1.5,
        "gamma of the controller over the smallest one; more than 1 rolls off at high frequency",
        low=1.001,
        high=100.0,
    )
    integrator: bool = parameter(True, "make the controller's slowest pole an exact integrator")
    order: int = parameter(0, "order to reduce to, without the prefilter; 0: not reduced", low=0)
    prefilter: Prefilter = group(Prefilter)
    feedforward: float = parameter(
        0.0,
        "part of the filtered reference that goes straight to the command",
        low=-10.0,
        high=10.0,
    )
    follows: bool = parameter(
        False,
        "the prefilter F is what the finger shall do: what goes straight to the command is D(s) F r, and the "
        "controller sees what the reading of the nominal finger lacks of that",
    )
    controller: TransferFunction = group(TransferFunction)

    def __post_init__(self) -> None:
        if (self.method == "given") != bool(self.controller):
            raise ParameterError("'controller' must be given with method 'given' and only there")
        c = self.controller
        if c and (len(c.denominator) < 2 or not any(c.numerator)):
            raise ParameterError(
                f"'controller' is {c.numerator} / {c.denominator}, must have a numerator that is not 0 "
                "and a pole: its slowest pole is the integrator"
            )
        if self.follows and not self.prefilter.frequency:
            raise ParameterError(
                "'follows' is true, so 'prefilter.frequency' must be above 0: no finger moves at once"
            )
        if self.method != "hinf" and self.weights:
            raise ParameterError(f"'weights' are for method 'hinf', not for '{self.method}'")
