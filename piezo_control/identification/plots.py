# SPDX-License-Identifier: Apache-2.0
"""Pictures of identifications: what was measured against what the model says."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from piezo_control.identification.measurement import Measurement  # noqa: E402


def loops(measurement: Measurement, modelled: NDArray, samples: slice, path: Path) -> None:
    """Draw measured and modelled deflection (m) over voltage, and their difference over time."""
    voltage = measurement.voltage[samples]
    measured, modelled = measurement.deflection[samples] * 1e6, modelled[samples] * 1e6
    figure, (loop, error) = plt.subplots(1, 2, figsize=(11, 4.5), constrained_layout=True)
    loop.plot(voltage, measured, "tab:blue", lw=1.2, label="measured")
    loop.plot(voltage, modelled, "tab:orange", lw=0.7, label="modelled")
    loop.set(xlabel="voltage [V]", ylabel="deflection [µm]", title=Path(measurement.source).name)
    loop.legend()
    error.plot(measurement.time[samples], measured - modelled, lw=0.6)
    error.set(xlabel="t [s]", ylabel="measured − modelled [µm]")
    _finish(figure, path)


def responses(curves: list[tuple[str, NDArray]], path: Path) -> None:
    """Draw responses over time: per source an array of time (s), measured and modelled (m)."""
    figure, axes = plt.subplots(
        len(curves), 2, figsize=(11, 3.6 * len(curves)), constrained_layout=True, squeeze=False
    )
    for (response, error), (source, curve) in zip(axes, curves):
        time, measured, modelled = curve.T
        response.plot(time, measured * 1e6, "tab:blue", lw=1.2, label="measured")
        response.plot(time, modelled * 1e6, "tab:orange", lw=0.7, label="modelled")
        response.set(xlabel="t [s]", ylabel="deflection [µm]", title=Path(source).name)
        response.legend()
        error.plot(time, (measured - modelled) * 1e6, lw=0.6)
        error.set(xlabel="t [s]", ylabel="measured − modelled [µm]")
    _finish(figure, path)


def _finish(figure: plt.Figure, path: Path) -> None:
    for axis in figure.axes:
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
