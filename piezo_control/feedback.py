# SPDX-License-Identifier: Apache-2.0
"""Run-time feedback law: a discrete state-space controller with two degrees of freedom.

    e_k     = reference_k - deflection_k
    u_k     = c x_k + d e_k + reference_d r_k
    command = min(max(u_k, command_low), command_high)
    x_k+1   = a x_k + b e_k + reference_b r_k + anti_windup (command - u_k)

Reference, deflection and command are in metres: the inverse hysteresis behind the controller makes
the actuator look like a gain of one. With `reference_b` and `reference_d` left out the controller
sees the error only. ``controller: none`` is the same law without states and with reference_d = 1,
that is open loop.

Anti-windup is back-calculation: while the command is at a limit the states follow
``(a - anti_windup c) x``, which has to be stable, so they stay bounded however long that lasts.

Coefficients come from the ``synthesize`` command line; nothing but numpy is needed here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from piezo_control.hysteresis import REACH
from piezo_control.parameters import ParameterError, build, load, parameter
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.shared import shared_folder


@dataclasses.dataclass(frozen=True)
class FeedbackParameters:
    """Coefficients of the feedback law; matrices are row-major arrays, the order is len(c)."""

    controller: str = parameter(
        "none",
        "'state_space' closes the loop with the matrices below, 'none' passes the reference on",
        choices=("none", "state_space"),
    )
    name: str = parameter("open loop", "name of the design, for reports")
    certified: bool = parameter(
        False, "true when `synthesize` recomputed the closed loop and every specification was met"
    )
    temperature_undone: bool = parameter(
        False,
        "true when the gains it was designed for leave out what the temperature does to the stroke: the "
        "feedforward undoes that, `compensator: sensorless`",
    )
    sample_time: float = parameter(
        SAMPLE_TIME, "sample time the coefficients were designed for", unit="s", low=1e-6, high=1.0
    )
    delay_samples: int = parameter(
        1, "delay from the voltage to the reading that the coefficients were designed for", low=0,
        high=1000,
    )  # fmt: skip
    denominator: tuple[float, ...] = parameter(
        (), "denominator of the D(s) that they were designed for; none: not said"
    )
    command_low: float = parameter(
        REACH[0], "lowest command; the end of the inverse's reachable range", unit="m"
    )
    command_high: float = parameter(
        REACH[1], "highest command; the end of the inverse's reachable range", unit="m"
    )
    a: tuple[float, ...] = parameter((), "state matrix, order x order, row-major")
    b: tuple[float, ...] = parameter((), "input of the error to the states", unit="1/m")
    c: tuple[float, ...] = parameter((), "output of the states to the command", unit="m")
    d: float = parameter(0.0, "direct gain of the error to the command")
    reference_b: tuple[float, ...] = parameter(
        (), "input of the reference to the states; none: the error alone", unit="1/m"
    )
    reference_d: float = parameter(0.0, "direct gain of the reference to the command")
    anti_windup: tuple[float, ...] = parameter(
        (), "input of (limited - unlimited command) to the states", unit="1/m"
    )
    preview_band: float = parameter(
        0.0,
        "profiles and waveforms, known ahead, are followed without lag below this frequency; 0: as they come",
        unit="Hz", low=0.0, high=1e5,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if not self.command_low < self.command_high:
            raise ParameterError(
                f"'command_low' is {self.command_low!r}, must be below "
                f"'command_high' ({self.command_high!r}) m"
            )
        order = len(self.c)
        if self.controller == "none":
            if order or self.a or self.b or self.d or self.reference_b or self.reference_d:
                raise ParameterError("'controller' is 'none', so the matrices must be left out")
            return
        sizes = {"a": order**2, "b": order, "anti_windup": order}
        if self.reference_b:
            sizes["reference_b"] = order
        for name, size in sizes.items():
            if len(getattr(self, name)) != size:
                raise ParameterError(
                    f"'{name}' has {len(getattr(self, name))} elements, must have {size} "
                    f"for order {order} (the length of 'c')"
                )
        if order == 0 and self.d == 0.0:
            raise ParameterError("'c' is empty and 'd' is 0: the controller has no output")
        unwound = self.matrix("a") - np.outer(self.anti_windup, self.c)
        radius = max(abs(np.linalg.eigvals(unwound)), default=0.0)
        if not radius < 1.0:
            raise ParameterError(
                f"'anti_windup' leaves a - anti_windup c with a spectral radius of {radius:.6g}, "
                "must be below 1: the states would grow while the command is limited"
            )

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.c)

    def matrix(self, name: str) -> np.ndarray:
        """Return `a` as an (order, order) array, any other one as an (order,) array.

        An array that was left out is zero.
        """
        shape = (self.order, self.order) if name == "a" else (self.order,)
        values = getattr(self, name)
        return np.reshape(values, shape) if values else np.zeros(shape)


def known_controllers(folders: Sequence[Path] = ()) -> list[str]:
    """Return the names of the controllers that are in some folders; those that are shipped, where none is named."""
    places = folders or [shared_folder() / "params"]
    files = sorted(path for place in places for path in place.glob("feedback_*.yaml"))
    return list(dict.fromkeys(path.stem.removeprefix("feedback_") for path in files))


def controller_file(name: str, folder: Path | None = None) -> Path:
    """Return the file of the controller called `name`, from `folder` or the shipped ones, or the file of that path.

    Raises ParameterError naming the known controllers where there is no such file.
    """
    folders = [*([folder] if folder else []), shared_folder() / "params"]
    named = [place / f"feedback_{name}.yaml" for place in folders]
    try:
        path = next((path for path in [*named, Path(name)] if path.is_file()), None)
    except OSError:  # a name that no file can have
        path = None
    if path is None:
        known = ", ".join(known_controllers(folders))
        raise ParameterError(f"controller '{name}' is no file, and not one of the known {known}")
    return path


def read_controller(name: str, folder: Path | None = None) -> FeedbackParameters:
    """Return the controller called `name`; see :func:`controller_file`.

    Raises ParameterError naming the file, or the known controllers where there is no such file.
    """
    path = controller_file(name, folder)
    return build(FeedbackParameters, load(path, "feedback"), str(path))


def successor(name: str, present: FeedbackParameters) -> FeedbackParameters:
    """Return the controller that takes over from the `present` one: that of :func:`read_controller`, or 'none'.

    Open loop goes on at the sample time and with the limits of the present controller.
    """
    if name != "none":
        return read_controller(name)
    p = present
    return FeedbackParameters(
        sample_time=p.sample_time, command_low=p.command_low, command_high=p.command_high
    )


TEMPERATURE_REMAINS = (
    "its gains leave out what the temperature does to the stroke, and this feedforward does not undo that; "
    "'compensator: sensorless' of 'feedforward' does"
)


def uncovered(
    parameters: FeedbackParameters,
    delay_samples: int,
    denominator: Sequence[float],
    reach: tuple[float, float],
    undoes_temperature: bool,
) -> list[str]:
    """Return what the controller's certificate does not cover on a finger, in words; empty: nothing.

    Parameters
    ----------
    delay_samples, denominator, reach
        Delay from voltage to reading, D(s), and the deflections (m) that the finger reaches.
    undoes_temperature
        Whether the feedforward under the controller follows the temperature.
    """
    p = parameters
    if p.controller == "none":
        return []
    if not p.certified:
        return ["it is not certified"]
    found = []
    if p.delay_samples != delay_samples:
        found.append(
            f"it was made for a delay of {p.delay_samples} samples, here are {delay_samples}"
        )
    if p.denominator and not np.allclose(p.denominator, denominator, rtol=1e-6, atol=0.0):
        wanted, here = (
            math.sqrt(1.0 / d[0]) / (2.0 * math.pi) for d in (p.denominator, denominator)
        )
        found.append(
            f"it was made for a resonance of {wanted:.1f} Hz and D(s) {list(p.denominator)}, this finger has "
            f"{here:.1f} Hz and {list(denominator)}; its box covers some of that"
        )
    if p.command_low < reach[0] - 1e-9 or p.command_high > reach[1] + 1e-9:
        found.append(
            f"its commands of {p.command_low * 1e6:g} to {p.command_high * 1e6:g} µm leave the finger's reach of "
            f"{reach[0] * 1e6:.4g} to {reach[1] * 1e6:.4g} µm"
        )
    if p.temperature_undone and not undoes_temperature:
        found.append(TEMPERATURE_REMAINS)
    return found


def is_limited(
    parameters: FeedbackParameters, command: Any, reference: Any, by_controller: bool
) -> Any:
    """Say where a command (m) is held at an end of its range; numbers or arrays.

    A reference that passes through, so not `by_controller`, and is the end itself is not held there.
    """
    at_end = (command <= parameters.command_low) | (command >= parameters.command_high)
    return at_end & (by_controller | (command != reference))


class FeedbackCoefficients(NamedTuple):
    """What :func:`feedback_step` reads; the arrays are indexables of floats, `a` row-major."""

    a: Sequence[float]
    b: Sequence[float]
    c: Sequence[float]
    d: float
    reference_b: Sequence[float]
    reference_d: float
    anti_windup: Sequence[float]
    command_low: float
    command_high: float


class FeedbackState(NamedTuple):
    """What :func:`feedback_step` changes in place: the states and room for the next ones."""

    x: list[float]
    x_next: list[float]


def feedback_coefficients(parameters: FeedbackParameters) -> FeedbackCoefficients:
    """Return the coefficients of the kernel, as lists of floats."""
    is_open_loop = parameters.controller == "none"
    return FeedbackCoefficients(
        a=list(parameters.a),
        b=list(parameters.b),
        c=list(parameters.c),
        d=parameters.d,
        reference_b=parameters.matrix("reference_b").tolist(),
        reference_d=1.0 if is_open_loop else parameters.reference_d,
        anti_windup=list(parameters.anti_windup),
        command_low=parameters.command_low,
        command_high=parameters.command_high,
    )


def feedback_step(
    coefficients: FeedbackCoefficients, state: FeedbackState, reference: float, deflection: float
) -> float:
    """Return the command in m for one sample and advance `state` (see the module's equations)."""
    k = coefficients
    x = state.x
    x_next = state.x_next
    order = len(x)
    error = reference - deflection
    wanted = k.d * error + k.reference_d * reference
    for i in range(order):
        wanted += k.c[i] * x[i]
    command = min(max(wanted, k.command_low), k.command_high)
    excess = command - wanted
    for i in range(order):
        total = k.b[i] * error + k.reference_b[i] * reference + k.anti_windup[i] * excess
        for j in range(order):
            total += k.a[i * order + j] * x[j]
        x_next[i] = total
    for i in range(order):
        x[i] = x_next[i]
    return command


class Feedback:
    """The feedback law with its states.

    Parameters
    ----------
    parameters : FeedbackParameters

    Examples
    --------
    >>> feedback = Feedback(FeedbackParameters())
    >>> feedback.step(reference=5e-6, deflection=0.0)
    5e-06
    """

    def __init__(self, parameters: FeedbackParameters) -> None:
        self.parameters = parameters
        self._coefficients = feedback_coefficients(parameters)
        self.state = FeedbackState([0.0] * parameters.order, [0.0] * parameters.order)

    def step(self, reference: float, deflection: float) -> float:
        """Return the command in m for one sample of reference and deflection in m.

        Raises ValueError for an input that is not finite; the states stay as they were.
        """
        if not (math.isfinite(reference) and math.isfinite(deflection)):
            raise ValueError(
                f"reference {reference!r} m and deflection {deflection!r} m must be finite"
            )
        return feedback_step(self._coefficients, self.state, reference, deflection)

    def reset(self) -> None:
        """Put all states to zero: at rest with zero error and zero command."""
        self.state.x[:] = [0.0] * self.parameters.order

    def start(self, reference: float, deflection: float, command: float) -> None:
        """Choose the states so that the next step returns `command` (all in m): no bump.

        A controller without states (``none``) has nothing to choose: its command is what its equation
        says. A command outside the limits is limited first.

        Raises ParameterError when the controller cannot hold a command (a zero at z = 1).
        """
        p = self.parameters
        limited = min(max(command, p.command_low), p.command_high)
        self.state.x[:] = (hand_over(p) @ (reference, deflection, limited)).tolist()


def hand_over(parameters: FeedbackParameters) -> np.ndarray:
    """Return what the states are made of so that the next step returns a given command.

    The states are those of a constant error that would hold the command, so nothing but the error
    itself moves the command from there on. Also the way to hand over: build the new controller and start
    it with the last command of the old one.

    Returns
    -------
    2-D array with shape (order, 3)
        Times (reference, deflection, command), all in m, it is x.

    Raises
    ------
    ParameterError
        If the controller cannot hold a constant command (a zero at z = 1).
    """
    p = parameters
    n = p.order
    if n == 0:
        return np.zeros((0, 3))
    system = np.zeros((n + 1, n + 1))
    system[:n, :n] = np.eye(n) - p.matrix("a")
    system[:n, n] = -p.matrix("b")
    system[n, :n] = p.c
    right = np.zeros((n + 1, 3))
    right[:n, 0] = p.matrix("reference_b")
    right[n] = -p.d - p.reference_d, p.d, 1.0
    try:
        return np.linalg.solve(system, right)[:n]
    except np.linalg.LinAlgError:
        raise ParameterError(
            f"controller '{p.name}' cannot hold a constant command: it has a zero at z = 1"
        ) from None
