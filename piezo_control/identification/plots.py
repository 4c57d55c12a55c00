# SPDX-License-Identifier: Apache-2.0
"""Pictures of identifications: what was measured against what the model says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from piezo_control.identification.hysteresis import HysteresisModel
from piezo_control.identification.measurement import Measurement
from piezo_control.report.pictures import save


def loops(
    measurement: Measurement,
    modelled: NDArray,
    samples: slice,
    path: Path,
    model: HysteresisModel | None = None,
) -> None:
    """Draw measured and modelled deflection (m) over voltage, and their difference over time.

    With a `model`, its weights, too, and how well they are known.
    """
    voltage = measurement.voltage[samples]
    measured, modelled = measurement.deflection[samples] * 1e6, modelled[samples] * 1e6
    panels = 2 if model is None else 3
    figure = Figure(figsize=(5.5 * panels, 4.5), layout="constrained")
    loop, error, *others = figure.subplots(1, panels)
    loop.plot(voltage, measured, "tab:blue", lw=1.2, label="measured")
    loop.plot(voltage, modelled, "tab:orange", lw=0.7, label="modelled")
    loop.set(xlabel="voltage [V]", ylabel="deflection [µm]", title=Path(measurement.source).name)
    loop.legend()
    error.plot(measurement.time[samples], measured - modelled, lw=0.6)
    error.set(xlabel="t [s]", ylabel="measured − modelled [µm]")
    if model is not None:
        _weights(others[0], model)
    _finish(figure, path)


def _weights(axis: Axes, model: HysteresisModel) -> None:
    """Draw the plays' weights with their intervals; the first is the linear part, and much larger."""
    thresholds, weights = model.parameters.thresholds, np.array(model.parameters.weights) * 1e6
    widths = np.array(model.confidence["hysteresis.weights"]) * 1e6
    axis.errorbar(thresholds[1:], weights[1:], widths[1:], fmt="o", ms=3, capsize=3)
    axis.set(
        xlabel="threshold [V]",
        ylabel="weight [µm/V]",
        title=f"weights with 95 % intervals; the first: {weights[0]:.4g} ± {widths[0]:.2g} µm/V",
    )
    axis.title.set_fontsize("medium")


def responses(curves: list[tuple[str, NDArray]], found: list[str], path: Path) -> None:
    """Draw responses over time: per source an array of time (s), measured and modelled (m).

    What was `found`, with its intervals, stands above.
    """
    figure = Figure(figsize=(11, 3.6 * len(curves)), layout="constrained")
    axes = figure.subplots(len(curves), 2, squeeze=False)
    for (response, error), (source, curve) in zip(axes, curves):
        time, measured, modelled = curve.T
        response.plot(time, measured * 1e6, "tab:blue", lw=1.2, label="measured")
        response.plot(time, modelled * 1e6, "tab:orange", lw=0.7, label="modelled")
        response.set(xlabel="t [s]", ylabel="deflection [µm]", title=Path(source).name)
        response.legend()
        error.plot(time, (measured - modelled) * 1e6, lw=0.6)
        error.set(xlabel="t [s]", ylabel="measured − modelled [µm]")
    figure.suptitle("\n".join(["95 % intervals", *found]), fontsize="small")
    _finish(figure, path)


def _finish(figure: Figure, path: Path) -> None:
    for axis in figure.axes:
        axis.grid(alpha=0.3)
    save(figure, path)
