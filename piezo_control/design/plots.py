# SPDX-License-Identifier: Apache-2.0
"""Pictures of a controller: sensitivities and bounds, Nyquist, step responses, poles."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from piezo_control.design.certificate import Box, Certificate, transfer_response
from piezo_control.design.linear_loop import closed_loop, controller_response, respond
from piezo_control.design.problem import DesignProblem
from piezo_control.feedback import FeedbackParameters
from piezo_control.report.pictures import save

BOX = {"color": "tab:blue", "lw": 0.5, "alpha": 0.35}
NOMINAL = {"color": "k", "lw": 1.4}
BOUND = {"color": "tab:red", "lw": 1.2, "ls": "--"}


def draw(
    problem: DesignProblem,
    controller: FeedbackParameters,
    certificate: Certificate,
    folder: Path,
) -> list[Path]:
    """Draw all pictures into `folder` and return their paths."""
    box = Box(problem, resonance=5, damping=3, gain=3, points=1200)
    pictures = {
        "sensitivities": sensitivities(problem, controller, certificate.gamma, box),
        "nyquist": nyquist(controller, certificate, box),
        "steps": steps(problem, controller, box),
        "poles": poles(controller, box),
    }
    paths = []
    for name, figure in pictures.items():
        for axis in figure.axes:
            axis.grid(alpha=0.3)
        paths.append(save(figure, folder / f"{name}.png"))
    return paths


def sensitivities(
    problem: DesignProblem, controller: FeedbackParameters, gamma: float, box: Box
) -> Figure:
    """Draw |S|, |T|, |K S| and |G S| of the box against specifications and weights.

    The weights' bounds are gamma over the weight: for the disturbance path over both weights.
    """
    feedback, _ = controller_response(controller, box.z)
    sensitivity = 1.0 / (1.0 + feedback * box.plant)
    curves = {
        "S": sensitivity,
        "T": 1.0 - sensitivity,
        "K S": feedback * sensitivity,
        "G S": box.plant * sensitivity,
    }
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    hertz = box.frequency / (2.0 * np.pi)
    axes = dict(zip(curves, figure.subplots(2, 2, sharex=True).flat))
    for name, axis in axes.items():
        magnitude = _decibel(curves[name])
        _family(axis, hertz, magnitude)
        axis.set(xscale="log", ylabel=f"|{name}| [dB]", xlim=(1.0, hertz[-1]))
        axis.set_ylim(max(-80.0, magnitude.min() - 5.0), magnitude.max() + 10.0)
    if problem.weights:
        step = problem.finger.sample_time
        w = 2j / step * np.tan(0.5 * np.minimum(box.frequency * step, np.pi - 1e-9))
        performance, effort, disturbance = (
            transfer_response(weight, w)
            for weight in (
                problem.weights.performance,
                problem.weights.effort,
                problem.weights.disturbance,
            )
        )
        axes["S"].plot(hertz, _decibel(gamma / performance), label="γ / Ws", **BOUND)
        axes["K S"].plot(hertz, _decibel(gamma / effort), label="γ / Wu", **BOUND)
        axes["G S"].plot(
            hertz, _decibel(gamma / (performance * disturbance)), label="γ / (Ws Wd)", **BOUND
        )
    specification = problem.specification
    for name, limit in (("S", specification.sensitivity_peak), ("K S", specification.effort_peak)):
        axes[name].axhline(_decibel(limit), color="tab:red", lw=0.9, ls=":", label="specification")
    for axis in axes.values():
        axis.legend(loc="best", fontsize=8)
    for axis in list(axes.values())[2:]:
        axis.set_xlabel("f [Hz]")
    return figure


def nyquist(controller: FeedbackParameters, certificate: Certificate, box: Box) -> Figure:
    """Draw the open loops around -1, with the circle no loop may enter and the margins."""
    feedback, _ = controller_response(controller, box.z)
    loop = feedback * box.plant
    figure = Figure(figsize=(6.5, 6.5), layout="constrained")
    axis = figure.subplots()
    _family(axis, loop.real.T, loop.imag)
    peak = box.problem.specification.sensitivity_peak
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    axis.plot(np.cos(angle), np.sin(angle), color="0.6", lw=0.8)
    axis.plot(-1.0 + np.cos(angle) / peak, np.sin(angle) / peak, label=f"|S| = {peak:g}", **BOUND)
    axis.plot(-1.0, 0.0, "r+")
    n, w = certificate.nominal, certificate.worst
    axis.set(
        xlabel="Re L",
        ylabel="Im L",
        xlim=(-2.0, 2.0),
        ylim=(-2.0, 2.0),
        aspect="equal",
        title=(
            f"nominal (worst): gain {n['gain_up']:.3g} ({w['gain_up']:.3g}), phase "
            f"{n['phase_deg']:.0f}° ({w['phase_deg']:.0f}°), delay {1e3 * n['delay_s']:.2g} ms "
            f"({1e3 * w['delay_s']:.2g} ms)"
        ),
    )
    axis.title.set_fontsize(9)
    axis.legend(loc="upper right", fontsize=8)
    return figure


def steps(problem: DesignProblem, controller: FeedbackParameters, box: Box) -> Figure:
    """Draw the responses to steps of reference and force over the box."""
    loop = closed_loop(box.fingers, controller)
    samples = math.ceil(2.0 * problem.specification.settling_time / problem.finger.sample_time)
    time = np.arange(samples) * problem.finger.sample_time * 1e3
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    reference, force = figure.subplots(1, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        _family(reference, time, respond(loop, "reference", samples))
        _family(force, time, respond(loop, "force", samples))
    settling = 1e3 * problem.specification.settling_time
    for level in (0.95, 1.05):
        reference.plot([settling, time[-1]], [level, level], **BOUND)
    reference.axvline(settling, **BOUND)
    reference.set(xlabel="t [ms]", ylabel="reading / reference step", ylim=(-0.1, 1.4))
    for level in (-0.05, 0.05):
        force.axhline(level, **BOUND)
    force.set(xlabel="t [ms]", ylabel="reading / static deflection of a force step", ylim=(-2, 2))
    return figure


def poles(controller: FeedbackParameters, box: Box) -> Figure:
    """Draw the closed-loop poles of the box and those of the controller in the z-plane."""
    figure = Figure(figsize=(6.5, 6.5), layout="constrained")
    axis = figure.subplots()
    loops = np.linalg.eigvals(closed_loop(box.fingers, controller).a)
    own = np.linalg.eigvals(controller.matrix("a"))
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    axis.plot(np.cos(angle), np.sin(angle), color="0.6", lw=0.8)
    axis.plot(loops.real.ravel(), loops.imag.ravel(), "x", ms=3, color="tab:blue", label="loops")
    nominal = loops[len(loops) // 2]
    axis.plot(nominal.real, nominal.imag, "kx", ms=6, label="nominal loop")
    axis.plot(own.real, own.imag, "o", mfc="none", color="tab:orange", label="controller")
    axis.set(xlabel="Re z", ylabel="Im z", aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    axis.legend(loc="best", fontsize=8)
    return figure


def _family(axis: Axes, x: np.ndarray, lines: np.ndarray) -> None:
    """Draw one line per finger, the nominal one on top; `x` is common or one column per finger."""
    centre = len(lines) // 2
    axis.plot(x, lines.T, **BOX)
    axis.plot(x if x.ndim == 1 else x[:, centre], lines[centre], label="nominal", **NOMINAL)


def _decibel(value: np.ndarray | complex) -> np.ndarray:
    return 20.0 * np.log10(np.maximum(np.abs(value), 1e-12))
