"""Named experiments: from a YAML description to cases, and from a case to the parameters of every node."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from ament_index_python.packages import get_package_share_directory

from piezo_control.feedback_node import FeedbackNodeParameters
from piezo_control.feedforward_node import FeedforwardNodeParameters
from piezo_control.parameters import ParameterError, build, load
from piezo_control.profile import Profile
from piezo_sim.cantilever_node import CantileverNodeParameters
from piezo_sim.recorder_node import RecorderParameters
from piezo_sim.temperature_node import TemperatureNodeParameters

NODES = {
    "feedforward": FeedforwardNodeParameters,
    "feedback": FeedbackNodeParameters,
    "temperature": TemperatureNodeParameters,
    "recorder": RecorderParameters,
    "cantilever": CantileverNodeParameters,
}
"""Node name to parameters, in the order of activation: the master of time last."""

MODES = ("open_loop", "feedforward", "feedback")
NO_FORCE = {"shape": "step", "amplitude_mn": 0.0}
EXPERIMENT_KEYS = {"title", "controller", "sample_time", "plant", "runs"}
RUN_KEYS = {
    "name", "duration", "sample_time", "reference", "voltage", "tip_force", "mode", "controller",
    "plant", "temperature", "temperature_degc",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One run of one finger. Times in s; reference in m."""

    name: str
    mode: str
    controller: str
    plant: str
    sample_time: float
    duration: float
    reference: Profile
    tip_force: Profile
    temperature: Mapping[str, Any]

    @property
    def samples(self) -> int:
        """Number of samples of the run."""
        return round(self.duration / self.sample_time)

    def parameters(self, bag: Path | None = None) -> dict[str, Any]:
        """Return the parameter dataclass of every node for this run."""
        share = params_folder()
        changes: dict[str, dict[str, Any]] = {
            "feedforward": {
                "subscribers": 2,
                "sample_time": self.sample_time,
                "compensator": "static_gain" if self.mode == "open_loop" else "inverse",
            },
            "feedback": {"subscribers": 2, "sample_time": self.sample_time},
            "temperature": {"subscribers": 2, **self.temperature},
            "recorder": {"bag": str(bag or "")},
            "cantilever": {
                "subscribers": 2,
                "sample_time": self.sample_time,
                "samples": self.samples,
                "plant": self.plant,
                "temperature_lockstep": True,
            },
        }
        files = {
            "feedforward": share / "feedforward.yaml",
            "temperature": share / "temperature.yaml",
            "cantilever": share / "cantilever.yaml",
        }
        if self.mode == "feedback":
            files["feedback"] = share / f"feedback_{self.controller}.yaml"
            del changes["feedback"]["sample_time"]
        parameters = {}
        for name, kind in NODES.items():
            values = load(files[name], name) if name in files else {}
            parameters[name] = build(
                kind, {**values, **changes[name]}, f"case '{self.name}': {name}"
            )
        return parameters


def params_folder() -> Path:
    """Return the folder of the package's installed parameter files."""
    return Path(get_package_share_directory("piezo_gripper")) / "params"


def read_experiment(path: Path, overrides: Mapping[str, Any]) -> tuple[str, list[Case]]:
    """Return title and cases of the experiment in `path`; `overrides` replace keys of every run.

    A run with several modes or temperatures becomes a case for each combination. Raises ParameterError
    naming file, run and key.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ParameterError(f"{path}: cannot be read: {error}") from None
    unknown = set(content) - EXPERIMENT_KEYS
    if unknown:
        raise ParameterError(f"{path}: unknown keys {sorted(unknown)}; known: {EXPERIMENT_KEYS}")
    common = {key: content[key] for key in ("controller", "sample_time", "plant") if key in content}
    cases: list[Case] = []
    for run in content["runs"]:
        unknown = set(run) - RUN_KEYS
        if unknown:
            raise ParameterError(f"{path}: run '{run.get('name')}': unknown keys {sorted(unknown)}")
        cases += _expand({**common, **run, **overrides}, f"{path}: run '{run.get('name')}'")
    return content["title"], cases


def _expand(run: dict[str, Any], where: str) -> list[Case]:
    temperatures = run.get("temperature_degc", [None])
    cases = []
    for mode, degc in itertools.product(run["mode"], temperatures):
        if mode not in MODES:
            raise ParameterError(f"{where}: mode is '{mode}', must be one of {MODES}")
        temperature = run.get("temperature") or {"profile": "constant", "base_degc": degc}
        suffix = "" if degc is None else f"_{degc:g}degc"
        cases.append(
            Case(
                name=f"{run['name']}_{mode}{suffix}",
                mode=mode,
                controller=run["controller"] if mode == "feedback" else "none",
                plant=run.get("plant", "prandtl_ishlinskii"),
                sample_time=run["sample_time"],
                duration=run["duration"],
                reference=profile(run["reference"], "um", 1e-6, where),
                tip_force=profile(run.get("tip_force", NO_FORCE), "mn", 1e-3, where),
                temperature=temperature,
            )
        )
    return cases


def profile(shape: Mapping[str, Any], unit: str, scale: float, where: str) -> Profile:
    """Return the profile that a mapping like {shape: step, amplitude_um: 20.0} describes.

    Shapes: `step` (at `start`), `sine` (`frequency_hz`, `periods`), `points` (`time`, `value_<unit>`,
    joined by straight lines). Values are in `unit`, `scale` SI units each.
    """
    values = dict(shape)
    kind = values.pop("shape", None)
    try:
        if kind == "points":
            made = Profile(
                values.pop("time"), np.multiply(values.pop(f"value_{unit}"), scale), True
            )
        elif kind == "step":
            height, start = values.pop(f"amplitude_{unit}") * scale, values.pop("start", 0.0)
            made = Profile([start], [height]) if start == 0 else Profile([0, start], [0, height])
        elif kind == "sine":
            height, frequency = values.pop(f"amplitude_{unit}") * scale, values.pop("frequency_hz")
            time = np.linspace(0.0, values.pop("periods") / frequency, 2000)
            made = Profile(time, height * np.sin(2 * np.pi * frequency * time), True)
        else:
            raise ParameterError(f"{where}: shape is {kind!r}, must be 'step', 'sine' or 'points'")
    except KeyError as error:
        raise ParameterError(f"{where}: shape '{kind}' needs {error}") from None
    if values:
        raise ParameterError(f"{where}: shape '{kind}' does not know {sorted(values)}")
    return made
