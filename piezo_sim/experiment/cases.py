# SPDX-License-Identifier: Apache-2.0
"""Named experiments: from a YAML description to cases, and from a case to the parameters of every node."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from piezo_control.feedback import controller_file, read_controller, uncovered
from piezo_control.feedforward import Feedforward
from piezo_control.identification.excitation import decaying_sine
from piezo_control.nodes.parameters import (
    FeedbackNodeParameters,
    FeedforwardNodeParameters,
    RecorderParameters,
)
from piezo_control.parameters import ParameterError, build, flatten, load
from piezo_control.profile import Profile
from piezo_control.safety import LARGEST_DEFLECTION, LARGEST_FORCE, LARGEST_VOLTAGE
from piezo_control.shared import shared_folder
from piezo_sim.nodes.parameters import CantileverNodeParameters, TemperatureNodeParameters
from piezo_sim.plant.amplifier import AmplifierParameters
from piezo_sim.plant.sensor import SensorParameters

NODES = {
    "feedforward": FeedforwardNodeParameters,
    "feedback": FeedbackNodeParameters,
    "temperature": TemperatureNodeParameters,
    "recorder": RecorderParameters,
    "cantilever": CantileverNodeParameters,
}
"""Node name to parameters, in the order of activation: the master of time last."""

COMPENSATORS = {
    "open_loop": "static_gain",
    "feedforward": "inverse",
    "sensorless": "sensorless",
    "feedback": "",
}
"""Mode of a case to compensator of its feedforward; empty: that of the parameter file, or the inverse."""
HOLDING = ("thermal", "force")
"""Analyses that need no motion."""
NO_FORCE = {"shape": "step", "amplitude_mn": 0.0}
EXPERIMENT_KEYS = {
    "title": "heading of the report",
    "controller": "controllers of the runs with feedback, by name or file; one, or a list",
    "sample_time": "sample time of every node (s)",
    "plant": "class of the plant: prandtl_ishlinskii or truth",
    "temperature_degc": "list of constant temperatures (°C), one case for each",
    "engine": "run on the engine instead of nodes: true or false",
    "params": "folder whose NODE.yaml and feedback_NAME.yaml replace defaults and shipped controllers",
    "runs": "list of runs, each with the keys below",
}
"""Keys of an experiment's YAML, with what they mean."""
RUN_KEYS = {
    **{key: text for key, text in EXPERIMENT_KEYS.items() if key not in ("title", "runs")},
    "name": "name of the run, the beginning of its cases' names",
    "analysis": "how its recording is analysed; the experiment's name if left out",
    "duration": "length (s)",
    "every": "on the engine: every so many samples are recorded",
    "mode": "open_loop, feedforward, sensorless or feedback; one, or a list",
    "reference": "profile of the reference: shape, amplitude_um, …",
    "voltage": "profile of the voltage instead, in open loop: shape, amplitude_v, …",
    "tip_force": "profile of a force on the tip: shape, amplitude_mn, …",
    "temperature": "parameters of the temperature node instead of temperature_degc",
    "preview_band": "with feedback: the reference is followed without lag below this frequency (Hz)",
}
"""Keys of a run; those of the experiment hold where a run does not say otherwise."""
NEEDED_KEYS = ("name", "duration", "sample_time", "mode")
UNITS = {"um": 1e-6, "v": 1.0, "mn": 1e-3}
SENSIBLE = {
    "um": (SensorParameters().resolution, LARGEST_DEFLECTION),
    "v": (0.0, LARGEST_VOLTAGE),
    "mn": (0.0, LARGEST_FORCE),
}
"""Unit to smallest and largest height in SI: metres given as micrometres are below what the sensor tells apart."""


@dataclass(frozen=True)
class Case:
    """One run of one finger. Times in s; reference in m, tip force in N.

    Parameter files in the folder `params`, named after their node or controller, take the place of the
    defaults and of the shipped controllers. `analysis` names the analysis of its recording; on the
    `engine`, every `every`-th sample is recorded.
    """

    name: str
    mode: str
    controller: str
    plant: str
    sample_time: float
    duration: float
    reference: Profile
    tip_force: Profile
    temperature: Mapping[str, Any]
    experiment: str = ""
    analysis: str = ""
    engine: bool = False
    every: int = 1
    params: Path | None = None
    preview_band: float = 0.0

    @property
    def samples(self) -> int:
        """Number of samples of the run."""
        return round(self.duration / self.sample_time)

    def parameters(self, bag: Path | None = None) -> dict[str, Any]:
        """Return the parameter dataclass of every node for this run."""
        grid = max(1e-3, self.sample_time)
        given = {n: own_parameters(self.params, n) for n in NODES}
        compensator = COMPENSATORS[self.mode] or given["feedforward"].get("compensator", "inverse")
        is_warm = compensator == "sensorless"
        changes: dict[str, dict[str, Any]] = {
            "feedforward": {
                "subscribers": 2,
                "sample_time": self.sample_time,
                "compensator": compensator,
                "temperature_lockstep": is_warm,
                "temperature_period": grid,
                # Without feedback the paper's steps are as steep as the amplifier goes.
                **(
                    {}
                    if self.mode == "feedback"
                    else {"slew_limit": AmplifierParameters().slew_limit}
                ),
            },
            "feedback": {"subscribers": 2},
            "temperature": {
                "subscribers": 3 if is_warm else 2,
                "period": grid,
                "ahead": 20 * grid,
                **self.temperature,
            },
            "recorder": {"bag": str(bag or "")},
            "cantilever": {
                "subscribers": 2,
                "sample_time": self.sample_time,
                "samples": self.samples,
                "plant": self.plant,
                "temperature_lockstep": True,
                "temperature_period": grid,
                "clock_period": 10 * grid,
            },
        }
        if self.mode == "feedback":
            given["feedback"] = flatten(read_controller(self.controller, self.params))
            if self.preview_band:
                given["feedback"]["preview_band"] = self.preview_band
        parameters: dict[str, Any] = {}
        for name, kind in NODES.items():  # the feedforward first: it knows what can be reached
            if name == "feedback" and self.mode != "feedback":
                reach = Feedforward(parameters["feedforward"], self.sample_time).reachable_range
                changes[name].update(
                    sample_time=self.sample_time, command_low=reach[0], command_high=reach[1]
                )
            parameters[name] = build(
                kind, {**given[name], **changes[name]}, f"case '{self.name}': {name}"
            )
        if parameters["feedback"].sample_time != self.sample_time:
            raise ParameterError(
                f"case '{self.name}': 'sample_time' is {self.sample_time:g} s, must be that of controller "
                f"'{self.controller}': {parameters['feedback'].sample_time:g} s"
            )
        return parameters


def parameter_files(case: Case) -> list[Path]:
    """Return the files that the parameters of a case come from; what has none is the paper's finger."""
    found = [case.params / f"{node}.yaml" for node in NODES if case.params]
    if case.mode == "feedback":
        found.append(controller_file(case.controller, case.params))
    return [path for path in found if path.exists()]


def own_parameters(folder: Path | None, node: str) -> dict[str, Any]:
    """Return what `folder`/NODE.yaml gives to a node; nothing where there is none.

    The finger of the paper needs no file: it is the default of every parameter. Raises ParameterError naming
    the file that the node would not load.
    """
    path = folder / f"{node}.yaml" if folder else None
    if path is None or not path.exists():
        return {}
    values = load(path, node)
    build(NODES[node], values, str(path))
    return values


def not_covered(cases: Iterable[Case]) -> list[str]:
    """Return what the certificates of the cases' controllers do not cover on their fingers, each once."""
    found: dict[str, None] = {}
    for case in cases:
        if case.mode != "feedback":
            continue
        nodes = case.parameters()
        plant = nodes["cantilever"]
        reach = Feedforward(nodes["feedforward"], case.sample_time).reachable_range
        for text in uncovered(
            nodes["feedback"],
            plant.sensor.delay_samples,
            plant.dynamics.denominator,
            reach,
            nodes["feedforward"].compensator == "sensorless",
        ):
            found[f"controller '{case.controller}': {text}"] = None
    return list(found)


class RunFailed(RuntimeError):
    """A run did not reach its end; the message names the node and what it said."""


@dataclass(frozen=True)
class CaseRun:
    """A case that ran: its bag, and how fast and by how many processes."""

    case: Case
    bag: Path
    steps_per_second: float
    processes: int


def params_folder() -> Path:
    """Return the folder of the package's own parameter files."""
    return shared_folder() / "params"


def read_experiment(name: str, overrides: Mapping[str, Any]) -> tuple[str, list[Case]]:
    """Return title and cases of the experiment `name`, a file in params/experiments.

    `overrides` replace keys of every run; `amplitude_um` and `amplitude_v` replace the height of the
    reference and of the voltage, wherever a run has one. A list of modes, controllers or temperatures
    makes a case of each combination and becomes part of its name. A file with `experiments` instead of
    `runs` stands for the cases of all of these, its other keys being overrides for them.

    Raises ParameterError naming file, run and key.
    """
    if "params" in overrides:
        need_parameters(overrides["params"])
    title, runs = _runs(name)
    _need_effect(overrides, [run for _, run, _ in runs])
    cases = [
        case
        for experiment, run, where in runs
        for case in _expand(experiment, _overridden(run, overrides), where)
    ]
    names = [case.name for case in cases]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"two cases are called '{name}': name nothing twice")
    return title, cases


def _runs(name: str) -> tuple[str, list[tuple[str, dict[str, Any], str]]]:
    """Return the title of an experiment, and (experiment, run, where that is written) of each run."""
    path = params_folder() / "experiments" / f"{name}.yaml"
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ParameterError(f"{path}: cannot be read: {error}") from None
    title = content.pop("title", name)
    members = content.pop("experiments", None)
    if members is not None:
        return title, [
            (experiment, _overridden(run, content), where)
            for member in members
            for experiment, run, where in _runs(member)[1]
        ]
    _refuse_unknown(content, EXPERIMENT_KEYS, str(path))
    runs = []
    for run in content.pop("runs"):
        where = f"{path}: run '{run.get('name')}'"
        _refuse_unknown(run, RUN_KEYS, where)
        runs.append((name, {**content, **run}, where))
    return title, runs


def _need_effect(overrides: Mapping[str, Any], runs: Iterable[Mapping[str, Any]]) -> None:
    """Refuse an override that changes nothing in any of the runs."""
    has_effect = {
        "controller": any("feedback" in _listed(run["mode"]) for run in runs),
        "amplitude_um": any("amplitude_um" in run.get("reference", {}) for run in runs),
        "amplitude_v": any("amplitude_v" in run.get("voltage", {}) for run in runs),
    }
    for name in overrides:
        if not has_effect.get(name, True):
            raise ParameterError(
                f"--{name.replace('_', '-')} has no effect on any run of this experiment"
            )


def need_parameters(folder: Path) -> None:
    """Refuse a folder that has nothing to replace anything with."""
    if not folder.is_dir():
        raise ParameterError(f"params: {folder} is no folder")
    fitting = [*(f"{node}.yaml" for node in NODES), "feedback_*.yaml"]
    if not any(path for name in fitting for path in folder.glob(name)):
        raise ParameterError(f"params: {folder} has none of {', '.join(fitting)}")


def _refuse_unknown(mapping: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    unknown = set(mapping) - set(known)
    if unknown:
        raise ParameterError(f"{where}: unknown keys {sorted(unknown)}; known: {sorted(known)}")


def _overridden(run: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    changes = dict(overrides)
    for signal, key in (("reference", "amplitude_um"), ("voltage", "amplitude_v")):
        height = changes.pop(key, None)
        if height is not None and key in run.get(signal, {}):
            run[signal] = {**run[signal], key: height}
    if "temperature" in run and "temperature_degc" in changes:
        first, *others = changes.pop("temperature_degc")
        change = {"amplitude_degc": others[-1] - first} if others else {}
        run["temperature"] = {**run["temperature"], "base_degc": first, **change}
    return {**run, **changes}


def _expand(experiment: str, run: dict[str, Any], where: str) -> list[Case]:
    for key in NEEDED_KEYS:
        if key not in run:
            raise ParameterError(f"{where}: key '{key}' is missing")
    for key in ("duration", "sample_time"):
        if not (isinstance(run[key], float) and 0.0 < run[key] < math.inf):
            raise ParameterError(
                f"{where}: '{key}' is {run[key]!r}, must be a number above 0.0 (s)"
            )
    if run["duration"] < 2 * run["sample_time"]:
        raise ParameterError(
            f"{where}: 'duration' is {run['duration']} s, needs two samples or more"
        )
    analysis, reference = run.get("analysis", experiment), _reference(run, where)
    if analysis not in HOLDING and not np.any(reference.value):
        raise ParameterError(f"{where}: amplitude is 0, and '{analysis}' needs a finger that moves")
    temperatures = [None] if "temperature" in run else run.get("temperature_degc", [22.0])
    modes, controllers = _listed(run["mode"]), _listed(run.get("controller", "none"))
    cases = []
    for mode, controller, degc in itertools.product(modes, controllers, temperatures):
        if mode not in COMPENSATORS:
            raise ParameterError(
                f"{where}: mode is '{mode}', must be one of {', '.join(COMPENSATORS)}"
            )
        if mode != "feedback":
            if controller != controllers[0]:
                continue  # without feedback, one case stands for all controllers
            controller = "none"
        parts = [run["name"]]
        parts += [mode] if isinstance(run["mode"], list) else []
        if len(controllers) > 1 and mode == "feedback":
            parts.append(Path(controller).stem.removeprefix("feedback_"))
        parts += [] if degc is None else [f"{degc:g}degc"]
        cases.append(
            Case(
                experiment=experiment,
                name="_".join(parts),
                analysis=analysis,
                mode=mode,
                controller=controller,
                plant=run.get("plant", "prandtl_ishlinskii"),
                sample_time=run["sample_time"],
                duration=run["duration"],
                reference=reference,
                tip_force=profile(run.get("tip_force", NO_FORCE), "mn", where),
                temperature=run.get("temperature") or {"profile": "constant", "base_degc": degc},
                engine=run.get("engine", False),
                every=run.get("every", 1),
                params=run.get("params"),
                preview_band=run.get("preview_band", 0.0),
            )
        )
    return cases


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _reference(run: Mapping[str, Any], where: str) -> Profile:
    """Return the reference; one that stands for a voltage is the voltage times the static gain."""
    if ("voltage" in run) == ("reference" in run):
        raise ParameterError(f"{where}: needs either 'reference' or 'voltage'")
    if "reference" in run:
        return profile(run["reference"], "um", where)
    if run["mode"] != "open_loop":
        raise ParameterError(f"{where}: 'voltage' needs mode: open_loop, it is {run['mode']}")
    voltage = profile(run["voltage"], "v", where)
    # The node divides by the gain of its own file, so the voltage is converted with that one.
    values = own_parameters(run.get("params"), "feedforward")
    gain = build(FeedforwardNodeParameters, values, where).static_gain
    return Profile(voltage.time, voltage.value * gain, voltage.linear)


def profile(shape: Mapping[str, Any], unit: str, where: str) -> Profile:
    """Return the profile that a mapping like {shape: step, amplitude_um: 20.0} describes.

    Values are in `unit` (um, v or mn), times in s. Shapes:

    * `step`: to `amplitude_<unit>` at `start` (default 0);
    * `sine`: `amplitude_<unit>`, `frequency_hz`, `periods`;
    * `decaying_sine`: `amplitude_<unit>`, `frequency_hz`, `cycles` (piezo_control.identification.excitation);
    * `points`: `time` and `value_<unit>`, joined by straight lines;
    * `multisine`: two periods of `period`, of about `lines` cosines with frequencies from 1 / `period` to
      `highest_rad_s`, evenly spaced on a logarithmic axis and multiples of the lowest one; equally
      high, with Schroeder's phases, `amplitude_<unit>` in total; a point every `spacing`.
    """
    values = dict(shape)
    kind = values.pop("shape", None)
    scale = UNITS[unit]
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
        elif kind == "decaying_sine":
            height = values.pop(f"amplitude_{unit}") * scale
            made = decaying_sine(height, values.pop("cycles"), values.pop("frequency_hz"))
        elif kind == "multisine":
            height = values.pop(f"amplitude_{unit}") * scale
            time, wave = multisine(
                *(values.pop(n) for n in ("period", "highest_rad_s", "lines", "spacing"))
            )
            made = Profile(time, height * wave, True)
        else:
            raise ParameterError(
                f"{where}: shape is {kind!r}, must be 'step', 'sine', 'decaying_sine', 'points' or "
                "'multisine'"
            )
    except KeyError as error:
        raise ParameterError(f"{where}: shape '{kind}' needs {error}") from None
    except (TypeError, ValueError) as error:
        raise ParameterError(f"{where}: shape '{kind}': {error}") from None
    if values:
        raise ParameterError(f"{where}: shape '{kind}' does not know {sorted(values)}")
    peak = float(np.max(np.abs(made.value))) / scale
    least, most = (value / scale for value in SENSIBLE[unit])
    if peak and not least <= peak <= most:
        raise ParameterError(
            f"{where}: shape '{kind}' goes to {peak:g} {unit}, must be 0 or from {least:g} to {most:g} {unit}"
        )
    return made


def multisine(
    period: float, highest_rad_s: float, lines: int, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return two periods of a multisine of peak value 1: time (s) and value, see :func:`profile`."""
    highest = int(highest_rad_s * period / (2.0 * np.pi))
    order = np.unique(np.rint(np.geomspace(1, highest, lines)))
    time = np.arange(2 * round(period / spacing)) * spacing
    index = np.arange(order.size)
    phase = -np.pi * index * (index - 1) / order.size
    wave = np.sum(
        [np.cos(2.0 * np.pi * n / period * time + p) for n, p in zip(order, phase)], axis=0
    )
    return time, wave / np.max(np.abs(wave))
