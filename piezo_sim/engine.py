# SPDX-License-Identifier: Apache-2.0
"""The loop in one process: the step functions of the nodes, one after the other, without ROS.

Per sample k, as over topics: the sensor reads, feedback turns reference and reading into a command,
feedforward the command into a voltage, and the cantilever goes on with voltage, temperature and tip
force held. For equal parameters and seed the samples are those of the nodes.

With numba the loop is compiled to machine code and kept on disk; without it the same functions run
as Python, slowly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from piezo_control import feedback as feedback_law
from piezo_control import feedforward as feedforward_law
from piezo_control.adaptation import adapt
from piezo_control.compiled import as_arrays, has_numba
from piezo_control.compiled import compiled as compile_loop
from piezo_control.design.preview import asked
from piezo_control.feedback import (
    FeedbackCoefficients,
    FeedbackParameters,
    FeedbackState,
    feedback_step,
    is_limited,
)
from piezo_control.feedforward import (
    FeedforwardCoefficients,
    FeedforwardParameters,
    FeedforwardState,
    feedforward_step,
)
from piezo_control.parameters import ParameterError
from piezo_control.profile import Profile, Signal
from piezo_control.recording.recording import Recording
from piezo_control.safety import VoltageParameters
from piezo_control.sensorless import (
    SensorlessCoefficients,
    SensorlessParameters,
    SensorlessState,
    expected,
    inverse_step,
    sensorless_coefficients,
    sensorless_rest,
    sensorless_step,
    take_over,
)
from piezo_control.sequence import grid_index
from piezo_control.thermal import REFERENCE_DEGC
from piezo_control.touch import (
    TouchCoefficients,
    TouchParameters,
    TouchState,
    feel,
    press,
    push_of,
    touch_coefficients,
    touch_rest,
)
from piezo_sim.plant import cantilever
from piezo_sim.plant.cantilever import (
    CantileverModel,
    CantileverParameters,
    CantileverState,
    advance,
    deflection_of,
    deviating,
    look,
)
from piezo_sim.temperature import TemperatureParameters, temperature

AT_ONCE = 1 << 16
"""Samples whose random draws are made together; the signals do not depend on it."""


@dataclass(frozen=True)
class Run(Recording):
    """A recording of every signal, and what no sensor says.

    `true_deflection` (m) is where the tip was, `total_force` (N) the sum of external and contact force,
    `clipped` the number of samples at which feedforward or amplifier limited the voltage.
    """

    true_deflection: np.ndarray
    total_force: np.ndarray
    clipped: int


class Inputs(NamedTuple):
    """What comes in from outside, per sample."""

    reference: np.ndarray
    temperature: np.ndarray
    tip_force: np.ndarray
    normal: np.ndarray
    uniform: np.ndarray


class Outputs(NamedTuple):
    """What is taken down of every `every`-th sample; `clips` counts how often a limit acted until then."""

    deflection: np.ndarray
    command: np.ndarray
    voltage: np.ndarray
    total_force: np.ndarray
    true_deflection: np.ndarray
    clips: np.ndarray


class SensorlessFinger(NamedTuple):
    """Coefficients and states of a finger without a sensor."""

    law: SensorlessCoefficients
    law_state: SensorlessState
    plant: CantileverModel
    plant_state: CantileverState


class TouchingFinger(NamedTuple):
    """Laws and plant of a finger that holds a force; the last two are of every sample."""

    law: TouchCoefficients
    law_state: TouchState
    models: SensorlessCoefficients
    models_state: SensorlessState
    expected: np.ndarray  # m, of the next reading: one number
    plant: CantileverModel
    plant_state: CantileverState
    max_force: np.ndarray  # N
    push: np.ndarray  # N, as estimated


class LedFinger(NamedTuple):
    """Laws and plant of a finger that a controller leads as long as there is a sensor."""

    feedback: FeedbackCoefficients
    feedback_state: FeedbackState
    models: SensorlessCoefficients
    models_state: SensorlessState
    expected: np.ndarray  # m, of the next reading: one number
    plant: CantileverModel
    plant_state: CantileverState
    led: int  # samples with a sensor


class Finger(NamedTuple):
    """Coefficients and states of all the laws of one finger."""

    feedback: FeedbackCoefficients
    feedback_state: FeedbackState
    feedforward: FeedforwardCoefficients
    feedforward_state: FeedforwardState
    plant: CantileverModel
    plant_state: CantileverState


def run(
    plant: CantileverParameters,
    feedforward: FeedforwardParameters,
    feedback: FeedbackParameters,
    temperatures: TemperatureParameters,
    reference: Profile,
    samples: int,
    tip_force: Profile | None = None,
    every: int = 1,
    compiled: bool | None = None,
) -> Run:
    """Run one finger for `samples` samples and return every `every`-th of them.

    Parameters
    ----------
    plant, feedforward, feedback, temperatures : parameter dataclasses
        ``controller: none`` in `feedback` opens the loop; with `preview_band` the reference is known ahead.
    reference, tip_force : Profile
        In m and N; no tip force means none from outside.
    compiled : bool, optional
        Compile with numba; by default if numba is installed.

    Raises ParameterError when the sample times of plant and controller differ, ValueError when
    `samples` or `every` is below 1.
    """
    h = plant.sample_time
    if feedback.controller != "none" and feedback.sample_time != h:
        raise ParameterError(
            f"feedback 'sample_time' is {feedback.sample_time} s, must be the cantilever's: {h} s"
        )
    finger = finger_at_rest(plant, feedforward, feedback, temperatures_of(temperatures, h, 1)[0])
    clipped = finger.feedforward_state.clipped
    made = _run(
        run_samples,
        finger,
        clipped,
        plant,
        temperatures,
        asked(reference, feedback),
        samples,
        tip_force,
        every,
        compiled,
    )
    return _told(made, reference, feedback, feedback.controller != "none")


def _told(made: Run, reference: Profile, feedback: FeedbackParameters, by_controller: Any) -> Run:
    """Put in a run what was asked for, whatever was known ahead of it, and where a command was held at its end."""
    made = replace(made, reference=reference.at(made.time))
    held = is_limited(feedback, made.command, made.reference, by_controller)
    return replace(made, limited=np.maximum(made.limited, held))


def run_sensorless(
    plant: CantileverParameters,
    sensorless: SensorlessParameters,
    temperatures: TemperatureParameters,
    reference: Profile,
    samples: int,
    tip_force: Profile | None = None,
    every: int = 1,
    compiled: bool | None = None,
) -> Run:
    """Run a finger whose voltage comes from its models and the thermocouple, no sensor in the loop.

    Parameters as in :func:`run`. Raises ParameterError when the models have no inverse.
    """
    degc = temperatures_of(temperatures, plant.sample_time, 1)[0]
    law = sensorless_coefficients(sensorless, plant.sample_time)
    sampled = cantilever.model(plant)
    finger = as_arrays(
        SensorlessFinger(
            law,
            sensorless_rest(law, degc),
            sampled,
            cantilever.rest(sampled, plant.sensor.delay_samples, degc),
        )
    )
    clipped = finger.law_state.clipped
    return _run(
        run_sensorless_samples, finger, clipped, plant, temperatures, reference, samples, tip_force,
        every, compiled,
    )  # fmt: skip


def run_touching(
    plant: CantileverParameters,
    touch: TouchParameters,
    models: SensorlessParameters,
    temperatures: TemperatureParameters,
    reference: Profile,
    max_force: Profile,
    samples: int,
    compiled: bool | None = None,
) -> tuple[Run, np.ndarray]:
    """Run a finger that pushes with `max_force` (N) at most; return it and the estimated push (N).

    Other parameters as in :func:`run`, the limits of the command those of ``FeedbackParameters()``. Raises
    ParameterError when the models have no inverse.
    """
    degc = temperatures_of(temperatures, plant.sample_time, 1)[0]
    command = FeedbackParameters()
    inverse = sensorless_coefficients(models, plant.sample_time)
    sampled = cantilever.model(plant)
    finger = as_arrays(
        TouchingFinger(
            touch_coefficients(touch, plant.sample_time, command.command_low, command.command_high),
            touch_rest(),
            inverse,
            sensorless_rest(inverse, degc),
            np.zeros(1),
            sampled,
            cantilever.rest(sampled, plant.sensor.delay_samples, degc),
            max_force.at(np.arange(samples) * plant.sample_time),
            np.empty(samples),
        )
    )
    clipped = finger.models_state.clipped
    got = _run(
        run_touching_samples, finger, clipped, plant, temperatures, reference, samples, None, 1,
        compiled,
    )  # fmt: skip
    return got, finger.push


def run_led(
    plant: CantileverParameters,
    feedback: FeedbackParameters,
    models: SensorlessParameters,
    temperatures: TemperatureParameters,
    reference: Profile,
    led: int,
    samples: int,
    tip_force: Profile | None = None,
    every: int = 1,
    compiled: bool | None = None,
) -> tuple[Run, SensorlessState]:
    """Run a finger led by a controller for `led` samples, then by its models; return it and their state.

    As long as there is a sensor, gain and offset of the models adapt, where their parameters say so. Other
    parameters as in :func:`run`. Raises ParameterError when the models have no inverse, or what the controller
    knows ahead (`preview_band`) would lead the models.
    """
    if feedback.preview_band and led < samples:
        raise ParameterError(
            f"'preview_band' is {feedback.preview_band:g} Hz, must be 0 where the sensor is taken away"
        )
    degc = temperatures_of(temperatures, plant.sample_time, 1)[0]
    inverse = sensorless_coefficients(models, plant.sample_time)
    sampled = cantilever.model(plant)
    finger = as_arrays(
        LedFinger(
            feedback_law.feedback_coefficients(feedback),
            FeedbackState([0.0] * feedback.order, [0.0] * feedback.order),
            inverse,
            sensorless_rest(inverse, degc),
            np.zeros(1),
            sampled,
            cantilever.rest(sampled, plant.sensor.delay_samples, degc),
            led,
        )
    )
    clipped = finger.models_state.clipped
    got = _run(
        run_led_samples, finger, clipped, plant, temperatures, asked(reference, feedback), samples, tip_force,
        every, compiled,
    )  # fmt: skip
    return _told(got, reference, feedback, got.number < led), finger.models_state


def temperatures_of(
    temperatures: TemperatureParameters, sample_time: float, samples: int
) -> np.ndarray:
    """Return the temperature (°C) of each of the first `samples` samples."""
    index = grid_index(np.arange(samples), sample_time, temperatures.period)
    return temperature(temperatures, 0, int(index[-1]) + 1)[index]


def _run(
    loop: Callable[..., None],
    finger: Any,
    clipped: np.ndarray,
    plant: CantileverParameters,
    temperatures: TemperatureParameters,
    reference: Signal,
    samples: int,
    tip_force: Profile | None,
    every: int,
    compiled: bool | None,
) -> Run:
    """Run `loop` over all samples; `clipped` is where the law of the voltage counts."""
    if samples < 1 or every < 1:
        raise ValueError(f"samples is {samples}, every is {every}: both must be 1 or more")
    time = np.arange(samples) * plant.sample_time
    references = reference.at(time)
    forces = np.zeros(samples) if tip_force is None else tip_force.at(time)
    degc = temperatures_of(temperatures, plant.sample_time, samples)
    outputs = Outputs(*np.empty((len(Outputs._fields), -(-samples // every))))
    fast = has_numba() if compiled is None else compiled
    loop = compile_loop(loop) if fast else loop
    noise, dropouts = cantilever.generators(plant.seed)
    for first in range(0, samples, AT_ONCE):
        last = min(first + AT_ONCE, samples)
        inputs = Inputs(
            references[first:last],
            degc[first:last],
            forces[first:last],
            noise.standard_normal(last - first),
            dropouts.random(last - first),
        )
        loop(finger, inputs, first, every, outputs)
    amplifier_clips = finger.plant_state.amplifier.clipped[0]
    return Run(
        number=np.arange(0, samples, every),
        time=time[::every],
        reference=references[::every],
        deflection=outputs.deflection,
        command=outputs.command,
        voltage=outputs.voltage,
        limited=(np.diff(outputs.clips, prepend=0.0) > 0.0).astype(float),
        temperature=degc[::every],
        tip_force=forces[::every],
        true_deflection=outputs.true_deflection,
        total_force=outputs.total_force,
        clipped=int(clipped[0] + amplifier_clips),
    )


class Deviations(NamedTuple):
    """Fingers that are not the nominal one: a factor for each finger, 1-D arrays of equal shape."""

    resonance: np.ndarray
    damping: np.ndarray  # of the damping ratio
    stroke: np.ndarray  # of H_s


def run_deviating(
    plant: CantileverParameters,
    feedforward: FeedforwardParameters,
    feedback: FeedbackParameters,
    temperature_degc: float,
    reference: Profile,
    samples: int,
    deviations: Deviations,
    random: np.random.Generator,
    compiled: bool | None = None,
) -> np.ndarray:
    """Run a finger for each of `deviations`, all under one controller, from rest.

    Parameters are those of :func:`run`; `random` draws what the sensors draw, so that the seed of `plant`
    is not used.

    Returns
    -------
    2-D array with shape (fingers, samples)
        What the sensors read (m).
    """
    count = len(deviations.resonance)
    inputs = Inputs(
        asked(reference, feedback).at(np.arange(samples) * plant.sample_time),
        np.full(samples, temperature_degc),
        np.zeros(samples),
        random.standard_normal((count, samples)),
        random.random((count, samples)),
    )
    finger = finger_at_rest(plant, feedforward, feedback, temperature_degc)
    memory = tuple(_leaves((finger.feedback_state, finger.feedforward_state, finger.plant_state)))
    deflection = np.empty((count, samples))
    unused = Outputs(*np.empty((len(Outputs._fields), samples)))
    fast = has_numba() if compiled is None else compiled
    loop = compile_loop(run_fingers) if fast else run_fingers
    at_rest = tuple(state.copy() for state in memory)
    loop(finger, memory, at_rest, deviations, inputs, deflection, unused)
    return deflection


def drive(
    plant: CantileverParameters,
    temperatures: TemperatureParameters,
    voltage: Profile,
    samples: int,
    tip_force: Profile | None = None,
    every: int = 1,
) -> Run:
    """Apply a `voltage` profile (V) to the bare cantilever; reference and command are that voltage."""
    limits = {f.name: getattr(plant.amplifier, f.name) for f in fields(VoltageParameters)}
    straight = FeedforwardParameters(compensator="static_gain", static_gain=1.0, **limits)
    open_loop = FeedbackParameters(
        command_low=limits["voltage_low"], command_high=limits["voltage_high"]
    )
    return run(plant, straight, open_loop, temperatures, voltage, samples, tip_force, every)


def finger_at_rest(
    plant: CantileverParameters,
    feedforward: FeedforwardParameters,
    feedback: FeedbackParameters,
    temperature_degc: float,
) -> Finger:
    """Return coefficients and initial states of a finger, as float64 arrays."""
    law = feedforward_law.Feedforward(feedforward, plant.sample_time)
    order = feedback.order
    sampled = cantilever.model(plant)
    return as_arrays(
        Finger(
            feedback_law.feedback_coefficients(feedback),
            FeedbackState([0.0] * order, [0.0] * order),
            law.coefficients,
            law.state,
            sampled,
            cantilever.rest(sampled, plant.sensor.delay_samples, temperature_degc),
        )
    )


def _leaves(tree: Any) -> Iterator[np.ndarray]:
    """Yield the arrays of nested tuples."""
    for branch in tree:
        if isinstance(branch, tuple):
            yield from _leaves(branch)
        else:
            yield branch


def run_fingers(
    finger: Finger,
    memory: tuple[np.ndarray, ...],
    at_rest: tuple[np.ndarray, ...],
    deviations: Deviations,
    inputs: Inputs,
    deflection: np.ndarray,
    others: Outputs,
) -> None:
    """Run one finger after the other in the same `memory`; row n of `deflection` is that of finger n."""
    for n in range(len(deflection)):
        for state, initial in zip(memory, at_rest):
            for i in range(len(state)):
                state[i] = initial[i]
        plant = deviating(
            finger.plant, deviations.resonance[n], deviations.damping[n], deviations.stroke[n]
        )
        run_samples(
            Finger(
                finger.feedback,
                finger.feedback_state,
                finger.feedforward,
                finger.feedforward_state,
                plant,
                finger.plant_state,
            ),
            Inputs(
                inputs.reference,
                inputs.temperature,
                inputs.tip_force,
                inputs.normal[n],
                inputs.uniform[n],
            ),
            0,
            1,
            Outputs(
                deflection[n],
                others.command,
                others.voltage,
                others.total_force,
                others.true_deflection,
                others.clips,
            ),
        )


def take_down(
    outputs: Outputs,
    row: int,
    command: float,
    voltage: float,
    clips: float,
    plant: CantileverModel,
    state: CantileverState,
) -> None:
    """Write what is known of a sample, before the finger goes on, into a row of `outputs`."""
    outputs.deflection[row] = state.readings[0]
    outputs.command[row] = command
    outputs.voltage[row] = voltage
    outputs.total_force[row] = state.tip_force[0]
    outputs.true_deflection[row] = deflection_of(plant, state)
    outputs.clips[row] = clips


def run_samples(finger: Finger, inputs: Inputs, first: int, every: int, outputs: Outputs) -> None:
    """Run the samples of `inputs`, the first one being number `first`."""
    plant = finger.plant
    state = finger.plant_state
    for n in range(len(inputs.reference)):
        look(plant, state, inputs.normal[n], inputs.uniform[n])
        deflection = state.readings[0]
        command = feedback_step(
            finger.feedback, finger.feedback_state, inputs.reference[n], deflection
        )
        voltage = feedforward_step(finger.feedforward, finger.feedforward_state, command, 1.0)
        if (first + n) % every == 0:
            row = (first + n) // every
            take_down(
                outputs, row, command, voltage, finger.feedforward_state.clipped[0], plant, state
            )
        advance(plant, state, voltage, inputs.temperature[n], inputs.tip_force[n])


def run_sensorless_samples(
    finger: SensorlessFinger, inputs: Inputs, first: int, every: int, outputs: Outputs
) -> None:
    """Run the samples of `inputs` without a sensor, the first one being number `first`."""
    plant = finger.plant
    state = finger.plant_state
    for n in range(len(inputs.reference)):
        look(plant, state, inputs.normal[n], inputs.uniform[n])
        reference = inputs.reference[n]
        voltage = sensorless_step(
            finger.law, finger.law_state, reference, inputs.temperature[n], 1.0
        )
        if (first + n) % every == 0:
            row = (first + n) // every
            take_down(outputs, row, reference, voltage, finger.law_state.clipped[0], plant, state)
        advance(plant, state, voltage, inputs.temperature[n], inputs.tip_force[n])


def run_touching_samples(
    finger: TouchingFinger, inputs: Inputs, first: int, every: int, outputs: Outputs
) -> None:
    """Run the samples of `inputs` with a force that is limited, the first one being number `first`."""
    law = finger.law
    law_state = finger.law_state
    models = finger.models
    models_state = finger.models_state
    plant = finger.plant
    state = finger.plant_state
    for n in range(len(inputs.reference)):
        look(plant, state, inputs.normal[n], inputs.uniform[n])
        deflection = state.readings[0]
        feel(law, law_state, finger.expected[0], deflection)
        limit = finger.max_force[first + n]
        command = press(law, law_state, inputs.reference[n], deflection, limit)
        warmth = models_state.body.degc[0] - REFERENCE_DEGC
        voltage = inverse_step(models, models_state, command, inputs.temperature[n], 1.0)
        finger.expected[0] = expected(models, models_state, voltage, warmth)
        finger.push[first + n] = push_of(law, law_state)
        if (first + n) % every == 0:
            row = (first + n) // every
            take_down(outputs, row, command, voltage, models_state.clipped[0], plant, state)
        advance(plant, state, voltage, inputs.temperature[n], inputs.tip_force[n])


def run_led_samples(
    finger: LedFinger, inputs: Inputs, first: int, every: int, outputs: Outputs
) -> None:
    """Run the samples of `inputs`, with a sensor until that is taken away, the first being number `first`."""
    models = finger.models
    models_state = finger.models_state
    plant = finger.plant
    state = finger.plant_state
    for n in range(len(inputs.reference)):
        look(plant, state, inputs.normal[n], inputs.uniform[n])
        deflection = state.readings[0]
        reference = inputs.reference[n]
        degc = inputs.temperature[n]
        warmth = models_state.body.degc[0] - REFERENCE_DEGC
        if first + n < finger.led:
            command = feedback_step(finger.feedback, finger.feedback_state, reference, deflection)
            adapt(models.adaptation, models_state.adapted, deflection)
            voltage = inverse_step(models, models_state, command, degc, 1.0)
        else:
            command = reference
            if first + n == finger.led:
                take_over(models_state, finger.expected[0], reference)
            voltage = sensorless_step(models, models_state, reference, degc, 1.0)
        finger.expected[0] = expected(models, models_state, voltage, warmth)
        if (first + n) % every == 0:
            row = (first + n) // every
            take_down(outputs, row, command, voltage, models_state.clipped[0], plant, state)
        advance(plant, state, voltage, degc, inputs.tip_force[n])
