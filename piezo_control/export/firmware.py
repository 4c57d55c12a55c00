# SPDX-License-Identifier: Apache-2.0
"""The law of a finger as C99: one pair of files, and a program that compares it with the engine.

What :func:`piezo_control.servo.law.servo_step` does with one controller in a loop that keeps its time. Every
coefficient is computed here; the C has the steps alone, and its sums keep the order of the law's, so that in
double precision it gives the law's samples bit for bit.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from piezo_control import safety
from piezo_control.export.vectors import vectors
from piezo_control.feedback import FeedbackParameters, feedback_coefficients, hand_over
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.files import replaced
from piezo_control.parameters import ParameterError
from piezo_control.servo import driver, law
from piezo_control.servo.parameters import ServoParameters

FLOAT_TOLERANCE = 1e-4
"""How far samples in single precision may be from the engine's, as part of the range of the voltage."""

NAMES = {
    **{name: getattr(driver, name) for name in ("FRESH", "NONE_IN_TIME", "FAILED")},
    **{name: getattr(safety, name) for name in ("NORMAL", "HOLDING", "RAMPING", "FAULT")},
    **{
        name: getattr(law, name)
        for name in (
            "NO_CAUSE", "SENSOR_SILENT", "SENSOR_FROZEN", "SENSOR_RANGE", "MODEL", "CYCLE", "DEVICE",
            "STOPPED",
        )
    },
}  # fmt: skip


def firmware(
    name: str,
    servo: ServoParameters,
    feedback: FeedbackParameters,
    feedforward: FeedforwardParameters,
    single: bool = False,
) -> dict[str, str]:
    """Return ``{file name: text}`` of header, source and test program.

    Parameters
    ----------
    name : str
        Prefix of every name that the files declare, and of the files.
    single : bool
        Single precision (float) instead of double.

    Raises
    ------
    ParameterError
        For a `name` that is none in C, and a number that single precision cannot hold.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name, re.ASCII):
        raise ParameterError(
            f"the name is {name!r}, must be letters, digits and '_', a letter first"
        )
    h = feedback.sample_time
    compensator = Feedforward(feedforward, h)
    settings = law.settings_of(servo, feedforward, h)
    operator = compensator.coefficients.operator
    words = {
        **NAMES,
        "name": name,
        "NAME": name.upper(),
        "real": "float" if single else "double",
        "exact": not single,
        "controller": _comment(feedback.name),
        "certified": feedback.certified,
        "feedforward": _described(feedforward),
        "sample_time": h,
        "delay": feedback.delay_samples,
        "write": "as soon as the voltage is there" if servo.write == "immediately" else "at the next edge",
        "amplifier_gain": servo.amplifier_gain,
        "amplifier_zero": servo.amplifier_zero,
        "largest_deflection": safety.LARGEST_DEFLECTION,
        "settings": settings,
        "limits": settings.voltage,
        "ramp_step": settings.voltage.ramp * h,
        "hold_samples": math.floor(settings.hold_samples),
        "frozen_samples": math.floor(settings.frozen_samples),
        "k": feedback_coefficients(feedback),
        "order": feedback.order,
        "hand_over": hand_over(feedback).ravel().tolist(),
        "inverting": compensator.coefficients.inverting,
        "static_gain": compensator.coefficients.static_gain,
        "step_limit": compensator.coefficients.step_limit,
        "operator": operator._asdict(),
        "inverse": compensator.coefficients.inverse._asdict(),
        "plays": len(operator.weights),
        "bent": bool(operator.upper_weights or operator.lower_weights),
        "rest_plays": compensator.state.hysteresis.plays,
        "vectors": vectors(servo, feedback, feedforward),
        "tolerance": FLOAT_TOLERANCE * (settings.voltage.high - settings.voltage.low),
    }  # fmt: skip
    environment = Environment(
        loader=PackageLoader("piezo_control.export", "."),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    number = _single if single else _double
    environment.filters["number"] = number
    environment.filters["exactly"] = _double
    environment.filters["lines"] = lambda values: _lines(map(number, values))
    return {
        f"{name}{end}": environment.get_template(f"finger{end}.j2").render(words)
        for end in (".h", ".c", "_test.c")
    }


def write(folder: Path, files: dict[str, str]) -> list[Path]:
    """Write the files, all or none, into `folder`, made if it is not there; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in files]
    with replaced(*paths) as places:
        for place, text in zip(places, files.values()):
            place.write_text(text)
    return paths


def _double(value: float) -> str:
    """Return the shortest constant of C that is this number."""
    return "NAN" if math.isnan(value) else repr(float(value))


def _single(value: float) -> str:
    """Return the shortest constant of C that is the number in single precision next to `value`."""
    if math.isnan(value):
        return "NAN"
    with np.errstate(over="ignore", under="ignore"):
        rounded = np.float32(value)
    if not np.isfinite(rounded) or (value != 0.0 and abs(rounded) < np.finfo(np.float32).tiny):
        raise ParameterError(f"{value!r} is out of the range of single precision; use double")
    return f"{rounded!s}f"


def _lines(constants: Iterable[str]) -> str:
    return textwrap.fill(", ".join(constants), 100, initial_indent="    ", subsequent_indent="    ")


def _comment(text: str) -> str:
    """Return `text` without what ends or begins a comment of C."""
    return re.sub(r"[^\w .,:()+-]", "_", text)


def _described(feedforward: FeedforwardParameters) -> str:
    """Say what kind of feedforward it is."""
    if feedforward.compensator == "static_gain":
        return f"static gain of {feedforward.static_gain:g} m/V"
    shape = feedforward.hysteresis
    text = f"inverse Prandtl-Ishlinskii, {len(shape.weights)} plays"
    bends = len(shape.upper_weights) + len(shape.lower_weights)
    if bends:
        text += f", {bends} dead zones"
    if shape.rate_coefficient:
        text += ", thresholds that grow with the rate"
    return text
