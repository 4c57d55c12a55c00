"""Pictures of recordings, in the units of the paper: ms, µm, V, °C."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402

from piezo_control.recording import Recording  # noqa: E402

TITLES = {
    "open_loop": "open loop (static gain)",
    "feedforward": "feedforward (inverse hysteresis)",
    "feedback": "feedforward and feedback",
}
WARM, COOL = "tab:red", "tab:blue"


def save(figure: plt.Figure, path: Path) -> Path:
    """Write the figure as PNG and free it."""
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)
    return path


def temperature_colour(recording: Recording) -> str:
    """Return blue for a cool finger and red for a warm one, as all figures have it."""
    return COOL if recording.temperature[0] < 27.0 else WARM


def steps(runs: Mapping[str, Mapping[str, Recording]], path: Path) -> Path:
    """Draw step responses, one panel per mode, one line per recording (mode to label to recording)."""
    figure, axes = plt.subplots(1, len(runs), figsize=(4.2 * len(runs), 3.6), sharey=True)
    for axis, (mode, recordings) in zip(axes, runs.items()):
        for label, recording in recordings.items():
            colour = temperature_colour(recording)
            axis.plot(recording.time * 1e3, recording.deflection * 1e6, colour, lw=1, label=label)
        axis.plot(recording.time * 1e3, recording.reference * 1e6, "k--", lw=0.8, label="reference")
        axis.set(title=TITLES[mode], xlabel="t [ms]")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("deflection [µm]")
    axes[-1].legend(loc="lower right")
    return save(figure, path)


def disturbance(recording: Recording, path: Path) -> Path:
    """Draw temperature, deflection error and voltage of a finger that holds its reference."""
    figure, axes = plt.subplots(3, 1, figsize=(8, 6), sharex=True)
    error = (recording.deflection - recording.reference) * 1e6
    held = recording.time > 0.1
    signals = (
        (recording.time, recording.temperature, "temperature [°C]"),
        (recording.time[held], error[held], "deflection − reference [µm]"),
        (recording.time, recording.voltage, "voltage [V]"),
    )
    for axis, (time, value, label) in zip(axes, signals):
        _line(axis, time, value, label)
    axes[-1].set_xlabel("t [s]")
    return save(figure, path)


def _line(axis: Axes, time: object, value: object, label: str) -> None:
    axis.plot(time, value, lw=0.9)
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
