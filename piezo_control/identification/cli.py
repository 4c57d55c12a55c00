# SPDX-License-Identifier: Apache-2.0
"""From recordings of a finger to the parameters its nodes load.

Reads rosbag2 folders and text files, and writes into one folder (--out), step by step:
feedforward.yaml (`hysteresis`), cantilever.yaml (`hysteresis`, `dynamics`, `stiffness`, `drift`), a
picture and the fit's figures (JSON) of each step. `check` judges identified parameters on another
recording.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from piezo_control.feedforward import FeedforwardParameters
from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification import checks, plots
from piezo_control.identification.columns import QUANTITIES, add_options, chosen_columns
from piezo_control.identification.drift import identify_drift
from piezo_control.identification.dynamics import DynamicsModel, identify_dynamics
from piezo_control.identification.hysteresis import (
    FitQuality,
    HysteresisModel,
    equal_thresholds,
    identify_hysteresis,
    quality,
    settled,
)
from piezo_control.identification.measurement import (
    Measurement,
    MeasurementError,
    is_bag,
    read_measurement,
)
from piezo_control.parameters import ParameterError, build, dump, flatten, load

LARGEST_RMS_PERCENT = 10.0
"""Of the stroke: a straight line through a piezo actuator's loop misses by 5 to 9 %."""


def main() -> int:
    """Run the command line and return its exit code: 0 done, 2 unusable input."""
    arguments = parse()
    console = Console()
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        for written in arguments.run(arguments, console):
            console.print(f"wrote {written}", soft_wrap=True)
    except (MeasurementError, ParameterError, OSError) as error:
        print(f"identify: {error}", file=sys.stderr)
        return 2
    return 0


def hysteresis(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify the hysteresis operator; write feedforward.yaml and cantilever.yaml."""
    path = arguments.out / "feedforward.yaml"
    if path.exists() and not arguments.overwrite:
        raise ParameterError(f"{path} exists; name a new --out or give --overwrite")
    measurement = read(arguments.recording, arguments)
    measurement.need_varying("voltage", "deflection")
    first = settled(measurement) if arguments.skip is None else arguments.skip
    last = len(measurement.time)
    if first < last:
        checks.static(measurement.part(slice(first, last)))
    thresholds = arguments.thresholds or equal_thresholds(measurement, arguments.plays)
    dead_zones = arguments.dead_zones if arguments.model == "modified" else 0
    lag = arguments.lag
    if lag is None:
        # The delay of a bag's deflections is known. A voltage held before its deflection counts there as
        # if reached at the end, but the finger smooths the steps: it is half a sample ahead of that.
        lag = -0.5 * measurement.sample_time if is_bag(arguments.recording) else "identify"

    def fit(end: int) -> HysteresisModel:
        return identify_hysteresis(
            measurement, thresholds, dead_zones, None if lag == "identify" else lag, first, end
        )

    def judge(model: HysteresisModel, samples: slice) -> FitQuality:
        modelled = model.deflection(measurement.time, measurement.voltage)
        return quality(measurement.deflection[samples], modelled[samples])

    split = last - int(arguments.hold_back * (last - first))
    fits = {}
    if split < last:
        before = fit(split)
        fits[f"first {split - first} samples, fitted"] = judge(before, slice(first, split))
        fits[f"last {last - split} samples, held back"] = judge(before, slice(split, last))
    model = fit(last)
    fits[f"all {last - first} samples, fitted"] = judge(model, slice(first, last))
    show(console, f"{arguments.model} hysteresis of {arguments.recording}", fits)
    modelled = model.deflection(measurement.time, measurement.voltage)
    fitted = slice(first, last)
    if hum := checks.hum(measurement.part(fitted), (measurement.deflection - modelled)[fitted]):
        console.print(f"{arguments.recording}: {hum}", soft_wrap=True)
    need_quality(str(arguments.recording), fits)
    console.print(
        f"lag {model.lag * 1e3:.3g} ms, offset {model.offset * 1e6:.4g} µm, "
        f"smoothness {model.smoothness:g}"
    )

    feedforward = FeedforwardParameters(
        static_gain=float(np.ptp(measurement.deflection[first:]) / np.ptp(measurement.voltage)),
        hysteresis=model.parameters,
    )
    whole = fits[f"all {last - first} samples, fitted"]
    comment = (
        f"{arguments.model} hysteresis identified from {arguments.recording}: rms "
        f"{whole.rms_percent:.3f} %, max {whole.maximum_percent:.2f} % of {whole.stroke * 1e6:.2f} um.\n"
        "The deflection shows lag seconds late and with the offset of the sensor; both are no part of the\n"
        "operator, and the feedforward does not use them. The limits of the voltage are\n"
        "no result of a measurement: they are the defaults until you write what your actuator stands."
    )
    dump(path, "feedforward", flatten(feedforward), comment)
    with path.open("a") as file:
        yaml.safe_dump(
            {"/**/identification": {"ros__parameters": {"lag": model.lag, "offset": model.offset}}},
            file,
        )
    picture = arguments.out / "hysteresis.png"
    plots.loops(measurement, modelled, fitted, picture)
    return [
        path,
        update_cantilever(
            arguments.out, comment.splitlines()[0], "hysteresis", flatten(model.parameters)
        ),
        picture,
        write_json(arguments.out / "hysteresis.json", {n: figures(f) for n, f in fits.items()}),
    ]


def check(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Judge feedforward.yaml of --out on a recording it was not identified from."""
    measurement = read(arguments.recording, arguments)
    path = arguments.out / "feedforward.yaml"
    values = load(path, "identification")
    model = HysteresisModel(stored_hysteresis(path), values["offset"], values["lag"], 0.0)
    samples = slice(arguments.skip or 0, None)
    modelled = model.deflection(measurement.time, measurement.voltage)
    modelled += np.mean((measurement.deflection - modelled)[samples])
    fit = quality(measurement.deflection[samples], modelled[samples])
    show(console, f"{path} on {arguments.recording}", {"offset of its own": fit})
    picture = arguments.out / "check.png"
    plots.loops(measurement, modelled, samples, picture)
    return [picture, write_json(arguments.out / "check.json", figures(fit))]


def dynamics(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify D(s) from a step or a sweep of the voltage; update cantilever.yaml."""
    measurement = read(arguments.recording, arguments).bridged()
    measurement.need_varying("voltage")
    stored = arguments.out / "feedforward.yaml"
    drive = measurement.voltage
    if stored.exists():
        drive = deflection_history(stored_hysteresis(stored), drive)
    return finish_dynamics("dynamics", measurement, drive, arguments, console)


def stiffness(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify the elastic constant from a step of the tip force; update cantilever.yaml."""
    measurement = read(arguments.recording, arguments).bridged()
    measurement.need_varying("tip_force")
    if np.ptp(measurement.voltage) > 0.0:
        k = int(np.flatnonzero(measurement.voltage != measurement.voltage[0])[0])
        raise measurement.error("voltage", k, "must be constant while the tip force changes")
    return finish_dynamics("stiffness", measurement, measurement.tip_force, arguments, console)


def finish_dynamics(
    name: str,
    measurement: Measurement,
    drive: np.ndarray,
    arguments: argparse.Namespace,
    console: Console,
) -> list[Path]:
    """Fit, show and store the response to `drive`."""
    model = identify_dynamics(measurement, drive)
    modelled = model.deflection(measurement.time, drive)
    fit = quality(measurement.deflection, modelled)
    fits = {"all samples, fitted": fit}
    show(console, f"{name} of {arguments.recording}", fits)
    need_quality(str(arguments.recording), fits)
    found = {
        "natural_frequency_hz": model.natural_frequency / (2.0 * np.pi),
        "damping_ratio": model.damping_ratio,
        "delay_samples": delay_of(model, arguments),
        "denominator": model.denominator,
    }
    change: dict[str, Any] = {"denominator": model.denominator}
    if name == "stiffness":
        change = {"elastic_constant": model.gain}
    found.update(change)
    for key, value in found.items():
        console.print(f"{key}: {value}")
    picture = arguments.out / f"{name}.png"
    curve = np.column_stack((measurement.time, measurement.deflection, modelled))
    plots.responses([(measurement.source, curve)], picture)
    comment = (
        f"{name} identified from {arguments.recording}: rms {fit.rms_percent:.3f} % of the stroke."
    )
    if name != "stiffness":
        update_cantilever(
            arguments.out, comment, "sensor", {"delay_samples": delay_of(model, arguments)}
        )
    return [
        update_cantilever(arguments.out, comment, "dynamics", change),
        picture,
        write_json(arguments.out / f"{name}.json", {**found, **figures(fit)}),
    ]


def delay_of(model: DynamicsModel, arguments: argparse.Namespace) -> int:
    """Return the age of a reading (samples): what was found, and what a bag was read with."""
    return model.delay_samples + is_bag(arguments.recording) * arguments.sensor_delay


def drift(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify creep and thermal deflection from long recordings; update cantilever.yaml."""
    stored = arguments.out / "feedforward.yaml"
    operator = stored_hysteresis(stored) if stored.exists() else HysteresisParameters()
    model = identify_drift(
        [read(path, arguments).bridged() for path in arguments.recording], operator
    )
    fits = {
        str(path): quality(curve[:, 1], curve[:, 2])
        for path, curve in zip(arguments.recording, model.fitted)
    }
    show(console, "creep and thermal deflection", fits)
    need_quality("creep and thermal deflection", fits)
    found = {name: value for name, value in asdict(model).items() if name != "fitted"}
    for key, value in found.items():
        console.print(f"{key}: {value}")
    picture = arguments.out / "drift.png"
    plots.responses(list(zip(map(str, arguments.recording), model.fitted)), picture)
    names = ", ".join(map(str, arguments.recording))
    comment = f"Creep and thermal deflection identified from {names}."
    written = []
    if model.creep_gain + model.creep_gain_per_degc > 0.0:
        creep = {
            "gain": model.creep_gain,
            "gain_per_degc": model.creep_gain_per_degc,
            "times": model.creep_times,
            "shares": model.creep_shares,
        }
        written.append(update_cantilever(arguments.out, comment, "creep", creep))
    if model.time_constant > 0.0:
        thermal = {"sensitivity": model.sensitivity, "time_constant": model.time_constant}
        written.append(update_cantilever(arguments.out, comment, "thermal", thermal))
    return [
        *dict.fromkeys(written),
        picture,
        write_json(
            arguments.out / "drift.json",
            {**found, "fits": {name: figures(fit) for name, fit in fits.items()}},
        ),
    ]


def read(path: Path, arguments: argparse.Namespace) -> Measurement:
    """Read one recording, or its part, with the columns and units of the command line."""
    columns, sample_time = chosen_columns(arguments, QUANTITIES)
    measurement = read_measurement(
        path,
        columns,
        sample_time,
        arguments.finger,
        arguments.run_number,
        arguments.sensor_delay,
    )
    print(f"{path}: {measurement.description}")
    if arguments.reversed:
        print(f"{path}: deflection read with its sign reversed")
        measurement = replace(measurement, deflection=-measurement.deflection)
    time = measurement.time - measurement.time[0]
    begin, end = np.searchsorted(time, (arguments.start, arguments.end))
    return measurement.part(slice(int(begin), int(end)))


def stored_hysteresis(path: Path) -> HysteresisParameters:
    """Return the operator in a parameter file of the feedforward node."""
    return build(FeedforwardParameters, load(path, "feedforward"), str(path)).hysteresis


def update_cantilever(out: Path, comment: str, group: str, found: Mapping[str, Any]) -> Path:
    """Put a `group` of parameters that was found into cantilever.yaml, keeping what is there."""
    path = out / "cantilever.yaml"
    values, comments = {}, []
    if path.exists():
        values = load(path, "cantilever")
        comments = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
    values.update({f"{group}.{name}": value for name, value in found.items()})
    dump(path, "cantilever", values, "\n".join(dict.fromkeys([*comments, comment])))
    return path


def need_quality(source: str, fits: Mapping[str, FitQuality]) -> None:
    """Raise MeasurementError for a fit that explains too little to be written."""
    for part, fit in fits.items():
        if not fit.rms_percent <= LARGEST_RMS_PERCENT:
            raise MeasurementError(
                f"{source}: the fit explains too little ({part}: rms {fit.rms_percent:.1f} % of the stroke, "
                f"must be at most {LARGEST_RMS_PERCENT:g} %), nothing written; look for outliers, a reversed "
                "sign, wrong columns, or an actuator of another kind"
            )


def show(console: Console, title: str, fits: dict[str, FitQuality]) -> None:
    """Print the figures of fits as a table."""
    table = Table(title=title)
    for heading in ("", "rms µm", "max µm", "stroke µm", "rms %", "max %"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, fit in fits.items():
        lengths = (f"{value * 1e6:.4g}" for value in (fit.rms, fit.maximum, fit.stroke))
        table.add_row(name, *lengths, f"{fit.rms_percent:.3f}", f"{fit.maximum_percent:.2f}")
    console.print(table)


def figures(fit: FitQuality) -> dict[str, float]:
    """Return the figures of a fit for JSON: m and % of the stroke."""
    return {
        **asdict(fit),
        "rms_percent": fit.rms_percent,
        "maximum_percent": fit.maximum_percent,
    }


def write_json(path: Path, content: dict) -> Path:
    """Write `content` and return the path."""
    path.write_text(json.dumps(content, indent=2) + "\n")
    return path


def parse() -> argparse.Namespace:
    """Return the command line's arguments."""
    reading = argparse.ArgumentParser(add_help=False)
    add_options(reading, QUANTITIES)
    reading.add_argument(
        "--reversed", action="store_true", help="the sensor says less where the finger bends more"
    )
    bag = reading.add_argument_group("bags")
    bag.add_argument("--finger", default="", metavar="NAMESPACE", help="which of several fingers")
    bag.add_argument(
        "--run", dest="run_number", type=int, metavar="N", help="which of several runs"
    )
    bag.add_argument(
        "--sensor-delay", type=int, default=1, metavar="SAMPLES", help="age of a deflection (1)"
    )
    reading.add_argument(
        "--out", "-o", type=Path, default=Path("out/identified"), help="folder (out/identified)"
    )
    reading.add_argument("--start", type=float, default=0.0, metavar="S", help="use from here on")
    reading.add_argument("--end", type=float, default=np.inf, metavar="S", help="use up to here")

    parser = argparse.ArgumentParser(
        prog="identify", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True, metavar="WHAT")

    def command(function, several: bool = False) -> argparse.ArgumentParser:
        added = commands.add_parser(
            function.__name__,
            parents=[reading],
            help=function.__doc__,
            description=function.__doc__,
        )
        added.add_argument("recording", type=Path, nargs="+" if several else None)
        added.set_defaults(run=function)
        return added

    fit = command(hysteresis)
    fit.add_argument(
        "--model", choices=("modified", "classical"), default="modified",
        help="with dead zones for asymmetric actuators (default), or without",
    )  # fmt: skip
    fit.add_argument("--overwrite", action="store_true", help="replace an earlier result in --out")
    fit.add_argument("--plays", type=int, default=20, metavar="N", help="equal thresholds (20)")
    fit.add_argument("--thresholds", type=volts, metavar="V,V,...", help="thresholds instead")
    fit.add_argument("--dead-zones", type=int, default=3, metavar="N", help="on either side (3)")
    fit.add_argument(
        "--lag", type=seconds, metavar="S",
        help="lag of the deflection, or 'identify'; default: known of bags, 'identify' for text files",
    )  # fmt: skip
    fit.add_argument(
        "--skip", type=int, metavar="SAMPLES",
        help="not fitted; default: until the voltage has been to both ends",
    )  # fmt: skip
    fit.add_argument(
        "--hold-back", type=share, default=0.3, metavar="SHARE", help="of the samples (0.3)"
    )
    command(check).add_argument("--skip", type=int, metavar="SAMPLES", help="not judged")
    command(dynamics)
    command(stiffness)
    command(drift, several=True)
    return parser.parse_args()


def share(text: str) -> float:
    """Return a number from 0 to 0.9."""
    value = float(text)
    if not 0.0 <= value <= 0.9:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 0.9")
    return value


def seconds(text: str) -> float | str:
    """Return a number of seconds, or the word 'identify'."""
    return text if text == "identify" else float(text)


def volts(text: str) -> tuple[float, ...]:
    """Return the numbers of a list like '0,3,6'."""
    return tuple(float(entry) for entry in text.split(","))
