# SPDX-License-Identifier: Apache-2.0
"""Pictures of recordings, in the axes of the paper: ms, µm, V, rad/s, dB.

Every kind of experiment has one function; `PLOTS` lists them. Each draws panels, a mapping of a title to
what goes in there: a mapping of a label to the recordings with this label.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from piezo_control.metrics import last_cycle  # noqa: E402
from piezo_control.recording.recording import Recording  # noqa: E402
from piezo_control.report import pictures  # noqa: E402
from piezo_sim.experiment.analysis import frequency_response  # noqa: E402

Lines = Mapping[str, Sequence[Recording]]
Panels = Mapping[str, Lines]

UM, MS, MN = 1e6, 1e3, 1e3
COOL, WARM = "tab:blue", "tab:red"
OTHERS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:brown", "tab:pink")
WARM_FROM = 27.0  # °C
HELD = 0.02  # s before a disturbance over which the held deflection is averaged


def transient(panels: Panels, path: Path) -> Path:
    """Draw deflection over time after a step of the voltage, as Fig. 3."""
    figure, axes = _panels(panels)
    for axis, line, recording in _lines(axes, panels):
        axis.plot(recording.time * MS, recording.deflection * UM, lw=1, **line)
    _finish(axes, "t [ms]", "deflection [µm]")
    return save(figure, path)


def creep(panels: Panels, path: Path) -> Path:
    """Draw deflection over minutes after a step of the voltage, as Fig. 4."""
    figure, axes = _panels(panels)
    for axis, line, recording in _lines(axes, panels):
        axis.plot(recording.time, recording.deflection * UM, lw=1, **line)
        axis.set_ylim(-5, 35)
    _finish(axes, "t [s]", "deflection [µm]")
    return save(figure, path)


def hysteresis(panels: Panels, path: Path) -> Path:
    """Draw the last cycle of deflection over voltage, as Fig. 5."""
    figure, axes = _panels(panels)
    for axis, line, recording in _lines(axes, panels):
        cycle = last_cycle(recording.voltage)
        axis.plot(recording.voltage[cycle], recording.deflection[cycle] * UM, lw=1, **line)
    _finish(axes, "U [V]", "deflection [µm]", "upper left")
    return save(figure, path)


def excite(panels: Panels, path: Path) -> Path:
    """Draw every cycle of deflection over voltage."""
    figure, axes = _panels(panels)
    for axis, line, recording in _lines(axes, panels):
        axis.plot(recording.voltage, recording.deflection * UM, lw=0.7, **line)
    _finish(axes, "U [V]", "deflection [µm]", "upper left")
    return save(figure, path)


def feedforward(panels: Panels, path: Path) -> Path:
    """Draw the last cycle of deflection over reference, as Fig. 9."""
    figure, axes = _panels(panels)
    for axis, line, recording in _lines(axes, panels):
        cycle = last_cycle(recording.reference)
        reference = recording.reference[cycle] * UM
        axis.plot(reference, recording.deflection[cycle] * UM, lw=1, **line)
    for axis in axes:
        axis.axline((0, 0), slope=1, color="k", ls=":", lw=0.9, label="slope 1")
    _finish(axes, "reference [µm]", "deflection [µm]", "upper left")
    return save(figure, path)


def step(panels: Panels, path: Path, until: float | None = None) -> Path:
    """Draw the response to a step of the reference up to a time (s), as Fig. 13."""
    figure, axes = _panels(panels, sharey=True)
    for axis, line, recording in _lines(axes, panels):
        axis.plot(recording.time * MS, recording.deflection * UM, lw=1.2, **line)
    for axis, lines in zip(axes, panels.values()):
        recording = next(iter(lines.values()))[0]
        axis.plot(recording.time * MS, recording.reference * UM, "k--", lw=0.8, label="reference")
        axis.set_xlim(0, (until or recording.time[-1]) * MS)
    _finish(axes, "t [ms]", "deflection [µm]", "lower right")
    return save(figure, path)


def frequency(panels: Panels, path: Path) -> Path:
    """Draw the magnitude from the reference to the deflection, as Fig. 14."""
    figure, axes = _panels(panels, sharey=True)
    for axis, line, recording in _lines(axes, panels):
        response = frequency_response(recording)
        axis.semilogx(response.frequency, response.magnitude_db, ".-", lw=1, **line)
    for axis in axes:
        axis.axhline(-3, color="k", ls=":", lw=0.9, label="−3 dB")
        axis.set(xlim=(0.1, 1e4), ylim=(-18, 3))
    _finish(axes, "frequency [rad/s]", "magnitude [dB]", "lower left")
    return save(figure, path)


def thermal(panels: Panels, path: Path) -> Path:
    """Draw temperature, change of the held deflection and voltage over time."""
    return _disturbance(panels, path, "temperature", "temperature [°C]", 1.0)


def force(panels: Panels, path: Path) -> Path:
    """Draw tip force, change of the held deflection and voltage over time."""
    return _disturbance(panels, path, "tip_force", "tip force [mN]", MN)


def hold(panels: Panels, path: Path) -> Path:
    """Draw a deflection over time beside the reference at which it is held."""
    return step(panels, path)


def errors(panels: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]], path: Path) -> Path:
    """Draw errors (%) over time (s), a panel for each task and a line for each way to do it."""
    figure, axes = _panels(panels)
    for axis, lines in zip(axes, panels.values()):
        for colour, (label, (time, error)) in zip(OTHERS, lines.items()):
            axis.plot(time, error, color=colour, lw=0.8, label=label)
    _finish(axes, "t [s]", "error [%]")
    return save(figure, path)


PLOTS: dict[str, Callable[[Panels, Path], Path]] = {
    plot.__name__: plot
    for plot in (
        transient,
        creep,
        hysteresis,
        excite,
        feedforward,
        step,
        frequency,
        thermal,
        force,
        hold,
    )  # fmt: skip
}


def _disturbance(panels: Panels, path: Path, signal: str, label: str, scale: float) -> Path:
    count = len(panels)
    figure, grid = plt.subplots(
        3, count, figsize=(1.5 + 3.9 * count, 6.2), sharex=True, squeeze=False
    )
    for column, (title, lines) in enumerate(panels.items()):
        upper, middle, lower = grid[:, column]
        for _, line, recording in _lines([upper], {title: lines}):
            values = getattr(recording, signal)
            begin = int(np.argmax(values != values[0]))
            time = recording.time - recording.time[begin]
            held = np.mean(recording.deflection[(time >= -HELD) & (time < 0.0)])
            shown = time >= -max(HELD, 0.04 * time[-1])
            time = recording.time[shown]
            upper.plot(time, values[shown] * scale, lw=1, **line)
            middle.plot(time, (recording.deflection[shown] - held) * UM, lw=0.6, **line)
            lower.plot(time, recording.voltage[shown], lw=0.6, **line)
        upper.set_title(title)
        lower.set_xlabel("t [s]")
        if len(lines) > 1:
            upper.legend()
    for axis, text in zip(grid[:, 0], (label, "deflection −\nvalue held [µm]", "voltage [V]")):
        axis.set_ylabel(text)
    for axis in grid.flat:
        axis.grid(alpha=0.3)
    figure.align_ylabels()
    figure.tight_layout()
    return save(figure, path)


def _panels(panels: Panels, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel per entry, at most three in a row."""
    rows = math.ceil(len(panels) / 3)
    columns = math.ceil(len(panels) / rows)
    width = 6.0 if columns == 1 else 1.0 + 4.0 * columns
    figure, grid = plt.subplots(
        rows, columns, figsize=(width, 3.9 * rows), sharey=sharey, squeeze=False
    )
    for axis, title in zip(grid.flat, panels):
        axis.set_title(title)
    for spare in grid.flat[len(panels) :]:
        spare.remove()
    return figure, list(grid.flat[: len(panels)])


def _lines(
    axes: Sequence[Axes], panels: Panels
) -> Iterator[tuple[Axes, dict[str, str], Recording]]:
    """Yield axis, colour and legend entry, and recording of every line.

    Cool fingers are blue and warm ones red where that tells the lines of a panel apart.
    """
    for axis, lines in zip(axes, panels.values()):
        first = [recordings[0].temperature[0] for recordings in lines.values()]
        colours = [WARM if degc >= WARM_FROM else COOL for degc in first]
        if len(set(colours)) < len(colours):
            colours = [OTHERS[i % len(OTHERS)] for i in range(len(lines))]
        for colour, (label, recordings) in zip(colours, lines.items()):
            for i, recording in enumerate(recordings):
                yield axis, {"color": colour, "label": "" if i else label}, recording


def _finish(axes: Sequence[Axes], x: str, y: str, legend: str = "best") -> None:
    for axis in axes:
        axis.set_xlabel(x)
        axis.grid(alpha=0.3)
        axis.legend(loc=legend)
        if axis.get_subplotspec().is_first_col():
            axis.set_ylabel(y)
    axes[0].figure.tight_layout()


def save(figure: Figure, path: Path) -> Path:
    """Write the figure as :func:`pictures.save` does, and free it."""
    plt.close(figure)
    return pictures.save(figure, path)
