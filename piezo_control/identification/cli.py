# SPDX-License-Identifier: Apache-2.0
"""From recordings of a finger to the parameters its nodes load.

Reads rosbag2 folders, text files and those of other programs; a row of a table has a deflection beside the voltage
that was held until then (the delay is found). Writes into one folder (--out), step by step:
feedforward.yaml (`hysteresis`; after that `dynamics` and `drift`), cantilever.yaml (`hysteresis`,
`dynamics`, `stiffness`, `drift`), a picture, the same as a page (HTML) to zoom in, and the fit's figures (JSON) of each step. After `hysteresis
--model classical`, `dynamics` and `drift`, feedforward.yaml has all that `compensator: sensorless` needs.
`check` judges identified parameters on another recording.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

# Many small matrices: the threads of BLAS, started with numpy, would make a fit ten times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from piezo_control.creep import CreepParameters  # noqa: E402
from piezo_control.dynamics import DynamicsParameters, ModesParameters  # noqa: E402
from piezo_control.feedback import FeedbackParameters  # noqa: E402
from piezo_control.feedforward import FeedforwardParameters  # noqa: E402
from piezo_control.files import write_json  # noqa: E402
from piezo_control.hysteresis import HysteresisParameters, deflection_history  # noqa: E402
from piezo_control.identification import checks, plots  # noqa: E402
from piezo_control.identification.columns import QUANTITIES, add_options, chosen_columns  # noqa: E402
from piezo_control.identification.confidence import Values, lines  # noqa: E402
from piezo_control.identification.drift import SMALLEST_WARMING, identify_drift, is_loop  # noqa: E402
from piezo_control.identification.dynamics import (  # noqa: E402
    DynamicsModel,
    Static,
    identify_dynamics,
    need_vibration,
)
from piezo_control.identification.fit import FitQuality, need, noise, quality, straight  # noqa: E402
from piezo_control.identification.hysteresis import (  # noqa: E402
    HysteresisModel,
    equal_thresholds,
    identify_hysteresis,
    settled,
)
from piezo_control.identification.measurement import (  # noqa: E402
    Measurement,
    MeasurementError,
    is_bag,
    read_measurement,
)
from piezo_control.options import output_folder, within  # noqa: E402
from piezo_control.parameters import (  # noqa: E402
    ParameterError,
    build,
    declarations,
    dump,
    flatten,
    load,
    parameter,
)
from piezo_control.report.page import Section, write_html  # noqa: E402
from piezo_control.sensorless import SensorlessParameters  # noqa: E402
from piezo_control.thermal import REFERENCE_DEGC, ThermalParameters  # noqa: E402

GROUPS = {
    "hysteresis": HysteresisParameters,
    "dynamics": DynamicsParameters,
    "modes": ModesParameters,
    "creep": CreepParameters,
    "thermal": ThermalParameters,
}
"""Of the cantilever's parameters, those that are identified."""
LIMITS_COMMENT = """The limits of the voltage are no result of a measurement: they are the defaults until you write what
your actuator stands."""
SENSOR_COMMENT = """The deflection shows lag seconds late and with the offset of the sensor; both are no part of the
operator, and the feedforward does not use them. For `identify check`."""
LARGEST_SHARE_OF_VOLTAGE = 0.01
"""Of a deflection under a tip force: so much the voltage may move, which the elastic constant takes for its own."""


@dataclass(frozen=True)
class SensorParameters:
    """What a sensor shows besides the operator's deflection."""

    lag: float = parameter(0.0, "lag of the deflection", unit="s", low=-1e3, high=1e3)
    offset: float = parameter(0.0, "shown where the operator says 0", unit="m")


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 done, 2 unusable input."""
    arguments = parse(words)
    console = Console()
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        paths = arguments.run(arguments, console)
        pictures = [(path, path.stem) for path in paths if path.suffix == ".png"]
        for picture, name in pictures:
            title, source = f"identify {name}", str(arguments.recording)
            section = Section(source, figures=[(picture, "measured and modelled")])
            paths.append(write_html(picture.with_suffix(".html"), title, [section]))
        for written in paths:
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

    def judge(model: HysteresisModel, end: int, samples: slice) -> FitQuality:
        modelled = model.deflection(measurement.time, measurement.voltage)
        line = straight(measurement.deflection, measurement.voltage, fitted=slice(first, end))
        is_line = len(thresholds) == 1 and not dead_zones
        less = None if is_line else line[samples]
        return quality(measurement.deflection[samples], modelled[samples], less)

    split = last - int(arguments.hold_back * (last - first))
    fits = {}
    if split < last:
        before = fit(split)
        fits[f"first {split - first} samples, fitted"] = judge(before, split, slice(first, split))
        fits[f"last {last - split} samples, held back"] = judge(before, split, slice(split, last))
    model = fit(last)
    fits[f"all {last - first} samples, fitted"] = judge(model, last, slice(first, last))
    show(console, f"{arguments.model} hysteresis of {arguments.recording}", fits)
    modelled = model.deflection(measurement.time, measurement.voltage)
    fitted = slice(first, last)
    if hum := checks.hum(measurement.part(fitted), (measurement.deflection - modelled)[fitted]):
        console.print(f"{arguments.recording}: {hum}", soft_wrap=True)
    reason = checks.one_branch(measurement, slice(first, split))
    need(str(arguments.recording), fits, "a straight line", reason)
    console.print(
        f"lag {model.lag * 1e3:.3g} ms, offset {model.offset * 1e6:.4g} µm, "
        f"smoothness {model.smoothness:g}"
    )
    share = model.parameters.virgin_share
    console.print(f"virgin share {share:.3g}" if share else f"virgin share 0: {model.untold}")

    feedforward = FeedforwardParameters(
        static_gain=float(np.ptp(measurement.deflection[first:]) / np.ptp(measurement.voltage)),
        hysteresis=model.parameters,
    )
    found = flatten(feedforward)
    build(FeedforwardParameters, found, str(arguments.recording))
    # What is there of other identifications, and the limits that somebody wrote, stay.
    limits = {n: v for n, v in found.items() if "." not in n and n != "static_gain"}
    whole = fits[f"all {last - first} samples, fitted"]
    comment = said(
        "hysteresis",
        f"{arguments.model}, identified from {arguments.recording}: rms {whole.rms_percent:.3f} %, max "
        f"{whole.maximum_percent:.2f} % of {whole.stroke * 1e6:.2f} um",
        {**found, "offset": model.offset, "lag": model.lag},
        model.confidence,
    )
    operator = {"hysteresis": flatten(model.parameters)}
    written = update(arguments.out / "cantilever.yaml", "hysteresis", comment, operator)
    if not path.exists():
        dump(path, "feedforward", limits, LIMITS_COMMENT)
    inverse = {"": {"static_gain": feedforward.static_gain}, **operator}
    update(path, "hysteresis", comment, inverse)
    sensor = arguments.out / "identification.yaml"
    dump(sensor, "identification", {"lag": model.lag, "offset": model.offset}, SENSOR_COMMENT)
    picture = arguments.out / "hysteresis.png"
    plots.loops(measurement, modelled, fitted, picture, model)
    return [
        path,
        sensor,
        written,
        *([write_polarity(arguments, console)] if arguments.reversed else []),
        picture,
        write_json(
            arguments.out / "hysteresis.json",
            {**{n: figures(f) for n, f in fits.items()}, "confidence": model.confidence},
        ),
    ]


def check(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Judge feedforward.yaml of --out on a recording it was not identified from."""
    measurement = read(arguments.recording, arguments)
    path = arguments.out / "feedforward.yaml"
    operator = stored_hysteresis(path)
    sensor = stored_sensor(arguments.out)
    model = HysteresisModel(operator, sensor.offset, sensor.lag, 0.0)
    samples = slice(arguments.skip or 0, None)
    measurement.part(samples).need_varying("voltage", "deflection")
    modelled = model.deflection(measurement.time, measurement.voltage)
    modelled += np.mean((measurement.deflection - modelled)[samples])
    fit = quality(measurement.deflection[samples], modelled[samples])
    show(console, f"{path} on {arguments.recording}", {"offset of its own": fit})
    picture = arguments.out / "check.png"
    plots.loops(measurement, modelled, samples, picture)
    return [picture, write_json(arguments.out / "check.json", figures(fit))]


def dynamics(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify D(s) from a step or a sweep of the voltage; update cantilever.yaml and feedforward.yaml."""
    measurement = read(arguments.recording, arguments).bridged()
    measurement.need_varying("voltage")
    stored = arguments.out / "feedforward.yaml"
    voltage = measurement.voltage
    static = partial(deflection_history, stored_hysteresis(stored)) if stored.exists() else None
    less = [static(voltage) if static else voltage]
    return finish_dynamics("dynamics", measurement, voltage, less, static, arguments, console)


def stiffness(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify the elastic constant from a step of the tip force; update cantilever.yaml."""
    measurement = read(arguments.recording, arguments).bridged()
    measurement.need_varying("tip_force")
    slope = sum(operator_of(arguments, console).weights)
    voltage, deflection = measurement.voltage, measurement.deflection
    # Noise of a voltmeter moves nothing; what is left of it moves the finger.
    moved = slope * np.sqrt(max(np.var(voltage) - noise(voltage) ** 2, 0.0))
    if moved > LARGEST_SHARE_OF_VOLTAGE * np.std(deflection):
        raise MeasurementError(
            f"{measurement.source}: column 'voltage' goes from {voltage.min():.4g} to {voltage.max():.4g} V while the "
            f"tip force changes: at {slope:.3g} m/V that is {100.0 * moved / np.std(deflection):.2g} % of the "
            f"deflection's deviation, must be at most {100.0 * LARGEST_SHARE_OF_VOLTAGE:g} %: hold the voltage"
        )
    return finish_dynamics(
        "stiffness", measurement, measurement.tip_force, [], None, arguments, console
    )


def finish_dynamics(
    name: str,
    measurement: Measurement,
    drive: np.ndarray,
    less: Sequence[np.ndarray],
    static: Static | None,
    arguments: argparse.Namespace,
    console: Console,
) -> list[Path]:
    """Fit, show and store the response to `drive`, through `static`, which has to explain more than `less` does."""
    checks.clipped(measurement)
    model = identify_dynamics(measurement, drive, arguments.modes if less else 1, static)
    if model.gain < 0.0:
        what = "voltage" if less else "tip_force"
        raise checks.reversed_sensor(measurement, f"gain {model.gain:.3g}", what)
    if less:
        need_vibration(measurement, drive, model, static)
    modelled = model.deflection(measurement.time, drive, static)
    fit = quality(
        measurement.deflection,
        modelled,
        straight(measurement.deflection, measurement.time - measurement.time[0], *less),
    )
    fits = {"all samples, fitted": fit}
    show(console, f"{name} of {arguments.recording}", fits)
    need(str(arguments.recording), fits, "a finger without vibration" if less else "no force")
    delay_samples, delay_words = delay_of(model, measurement, arguments)
    found: dict[str, Any] = {
        "natural_frequency_hz": model.natural_frequency / (2.0 * np.pi),
        "damping_ratio": model.damping_ratio,
        "delay": model.delay,
        "delay_samples": delay_samples,
        "denominator": model.denominator,
        "gain": model.gain,
    }
    confidence = dict(model.confidence)
    groups: dict[str, dict[str, Any]]
    if less:
        frequencies, damping, shares = zip(*model.modes) if model.modes else ((), (), ())
        modes = {
            "frequency_hz": tuple(w / (2.0 * np.pi) for w in frequencies),
            "damping": damping,
            "share": shares,
        }
        groups = {
            "dynamics": {"denominator": model.denominator},
            "modes": modes,
            "sensor": {"delay_samples": delay_samples},
        }
        found.update({f"modes.{key}": value for key, value in modes.items() if value})
        if static:  # a lag was looked for; 0 takes the place of one that was found before
            groups["amplifier"] = {"bandwidth_hz": model.bandwidth_hz}
        if model.bandwidth_hz:
            found["amplifier.bandwidth_hz"] = model.bandwidth_hz
    else:
        groups = {"dynamics": {"elastic_constant": found.pop("gain")}}
        confidence["elastic_constant"] = confidence.pop("gain")
        found.update(groups["dynamics"])
    for line in lines(found, confidence):
        console.print(line, soft_wrap=True)
    console.print(delay_words, soft_wrap=True)
    comment = said(
        name,
        f"identified from {arguments.recording}: rms {fit.rms_percent:.3f} % of the stroke",
        found,
        confidence,
    )
    written = store(arguments.out, name, comment, groups)
    picture = arguments.out / f"{name}.png"
    curve = np.column_stack((measurement.time, measurement.deflection, modelled))
    plots.responses([(measurement.source, curve)], lines(found, confidence), picture)
    return [
        *written,
        picture,
        write_json(
            arguments.out / f"{name}.json", {**found, "confidence": confidence, **figures(fit)}
        ),
    ]


def delay_of(
    model: DynamicsModel, measurement: Measurement, arguments: argparse.Namespace
) -> tuple[int, str]:
    """Return the age of a reading in samples of the loop, and how it comes about in words.

    It is what was found, and what a bag was read with. The loop's sample time is that of the cantilever.yaml of
    --out, where it has one: a recording may be sampled faster.
    """
    stored = arguments.out / "cantilever.yaml"
    said = load(stored, "cantilever") if stored.exists() else {}
    sample_time = said.get("sample_time", FeedbackParameters().sample_time)
    row = measurement.sample_time
    known = is_bag(arguments.recording) * arguments.sensor_delay
    samples = replace(model, delay=model.delay + known * row).delay_samples(sample_time)
    words = (
        f"delay_samples: {samples}, of {sample_time * 1e6:g} µs in the loop; found are "
        f"{model.delay * 1e6:.4g} µs, {model.delay / row:.3g} rows of {row * 1e6:.4g} µs"
    )
    if row > 1.01 * sample_time:
        words += (
            ". A recording that is sampled more slowly than the loop tells little about the delay"
        )
    return samples, words


def drift(arguments: argparse.Namespace, console: Console) -> list[Path]:
    """Identify creep and heat from long recordings; update cantilever.yaml and feedforward.yaml.

    From a loop among them that was recorded at 22 degC the operator is identified once more, without the creep.
    """
    stored = arguments.out / "feedforward.yaml"
    operator = operator_of(arguments, console)
    measurements = [read(path, arguments).bridged() for path in arguments.recording]
    model = identify_drift(measurements, operator)
    fits = {
        fit.source: replace(
            quality(fit.curve[:, 1], fit.curve[:, 2], fit.without), stroke=fit.stroke
        )
        for fit in model.fitted
    }
    show(console, "creep and thermal deflection", fits)
    need("creep and thermal deflection", fits, "a finger without creep and heat")
    found = {name: getattr(model, name) for name in model.confidence}
    for line in lines(found, model.confidence):
        console.print(line, soft_wrap=True)
    told = {name for name, half in model.confidence.items() if np.all(np.abs(found[name]) > half)}
    names = ", ".join(map(str, arguments.recording))
    notes: list[str] = []
    groups: dict[str, dict[str, Any]] = {}
    if "creep_gain" in told:
        gain, per_degc = model.creep_gain, model.creep_gain_per_degc
        if "creep_gain_per_degc" not in told:
            warmth = model.creep_degc - REFERENCE_DEGC
            seen, per_degc = gain + per_degc * warmth, stored_creep(arguments.out).gain_per_degc
            gain = max(0.0, seen - per_degc * warmth)
            notes.append(
                f"creep_gain was {seen:.4g} m/V at {model.creep_degc:.3g} °C; how it depends on the temperature these "
                f"recordings do not tell: taken as {per_degc:.4g} m/V per °C, "
                + ("which was known" if per_degc else "the same at 22 °C and at all others")
            )
        groups["creep"] = {
            "gain": gain,
            "gain_per_degc": per_degc,
            "times": model.creep_times,
            "shares": model.creep_shares,
        }
    thermal: dict[str, float] = {}
    # What is not told of a pair is 0 in it: the other was found beside that.
    for pair, is_told in (
        (("gain_per_degc", "lag_per_degc"), {"gain_per_degc", "lag_per_degc"} & told),
        (("sensitivity", "time_constant"), {"sensitivity"} & told),
    ):
        if is_told:
            thermal |= {name: getattr(model, name) * (name in told) for name in pair}
        else:
            notes.append(f"{' and '.join(pair)} are not told from 0: not written")
    if thermal:
        groups["thermal"] = thermal
    if "creep" not in groups:
        notes.append("creep is not told from 0: not written")
    for note in notes:
        console.print(note, soft_wrap=True)
    source = "; ".join((f"identified from {names}", *notes))
    comment = said("drift", source, found, model.confidence)
    written = store(arguments.out, "drift", comment, groups) if groups else []
    loop = next(filter(is_cold_loop, measurements), None)
    if loop and stored.exists() and "creep" in groups:
        lag = stored_sensor(arguments.out).lag
        dead_zones = len(operator.upper_thresholds)
        fresh = identify_hysteresis(model.cleared(loop), operator.thresholds, dead_zones, lag)
        comment = f"hysteresis: without this creep, identified once more from {loop.source}"
        cleared = {"hysteresis": flatten(fresh.parameters)}
        written += store(arguments.out, "hysteresis", comment, cleared)
    picture = arguments.out / "drift.png"
    plots.responses(
        [(fit.source, fit.curve) for fit in model.fitted],
        lines(found, model.confidence),
        picture,
    )
    return [
        *written,
        picture,
        write_json(
            arguments.out / "drift.json",
            {
                **found,
                "confidence": model.confidence,
                "fits": {name: figures(fit) for name, fit in fits.items()},
            },
        ),
    ]


def is_cold_loop(measurement: Measurement) -> bool:
    """Say whether a recording is a loop at the temperature that hysteresis is identified at."""
    degc = measurement.temperature
    is_cold = degc is not None and bool(np.all(np.abs(degc - REFERENCE_DEGC) < SMALLEST_WARMING))
    return is_cold and is_loop(measurement.voltage[settled(measurement) :])


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


def operator_of(arguments: argparse.Namespace, console: Console) -> HysteresisParameters:
    """Return the operator in --out, or the paper's, and say so."""
    stored = arguments.out / "feedforward.yaml"
    if stored.exists():
        return stored_hysteresis(stored)
    console.print(f"no {stored}: the hysteresis is taken as that of the paper's finger")
    return HysteresisParameters()


def stored_hysteresis(path: Path) -> HysteresisParameters:
    """Return the operator in a parameter file of the feedforward node."""
    values = load(path, "feedforward")
    operator = {n: value for n, value in values.items() if n.startswith("hysteresis.")}
    return build(FeedforwardParameters, operator, str(path)).hysteresis


def stored_creep(folder: Path) -> CreepParameters:
    """Return how creep depends on the temperature by cantilever.yaml, not at all where it says nothing."""
    path = folder / "cantilever.yaml"
    values = load(path, "cantilever") if path.exists() else {}
    per_degc = values.get("creep.gain_per_degc", 0.0)
    return build(CreepParameters, {"gain_per_degc": per_degc}, str(path))


def stored_sensor(folder: Path) -> SensorParameters:
    """Return what `hysteresis` wrote of the sensor."""
    path = folder / "identification.yaml"
    values = load(path, "identification")
    for name in declarations(SensorParameters):
        if name not in values:
            raise ParameterError(f"{path}: no '{name}', which `identify hysteresis` writes")
    return build(SensorParameters, values, str(path))


def said(name: str, source: str, found: Values, confidence: Values) -> str:
    """Return what a file says of an identification: its source, and how well each value is known."""
    texts = [
        source,
        "95 % intervals, by what the model leaves of these recordings; what it cannot describe elsewhere is not in them:",
        *lines(found, confidence),
    ]
    return "\n".join(f"{name}: {text}" for text in texts)


def store(
    out: Path, name: str, comment: str, groups: Mapping[str, Mapping[str, Any]]
) -> list[Path]:
    """Put the values by group that the identification `name` found where they are used; see :func:`update`.

    That is cantilever.yaml, and feedforward.yaml, where there is one, for the models that it has.
    """
    written = [update(out / "cantilever.yaml", name, comment, groups)]
    models = {f.name for f in fields(SensorlessParameters)}
    own = {group: found for group, found in groups.items() if group in models}
    if own and (out / "feedforward.yaml").exists():
        written.append(update(out / "feedforward.yaml", name, comment, own))
    return written


def update(path: Path, name: str, comment: str, groups: Mapping[str, Mapping[str, Any]]) -> Path:
    """Put the values by group that the identification `name` found into a node's file, keeping all else.

    The file has the name of its node. Raises ParameterError, and writes nothing, if the node would refuse
    them.
    """
    for group, found in groups.items():
        if group in GROUPS:
            build(GROUPS[group], found, f"identified {group}")
    values, comments = {}, []
    if path.exists():
        values = load(path, path.stem)
        comments = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
        comments = [line for line in comments if not line.startswith(f"{name}: ")]
    for group, found in groups.items():
        values.update({f"{group}.{entry}".lstrip("."): value for entry, value in found.items()})
    dump(path, path.stem, values, "\n".join([*comments, comment]))
    return path


def write_polarity(arguments: argparse.Namespace, console: Console) -> Path:
    """Tell the servo that the sensor says less where the finger bends more; a scale that is there stays."""
    path = arguments.out / "servo.yaml"
    if path.exists():
        scale = load(path, "servo").get("sensor_scale")
        console.print(
            f"{path} is there, with sensor_scale {scale}: it stays; the sensor of this recording is reversed",
            soft_wrap=True,
        )
        return path
    comment = (
        f"polarity identified from {arguments.recording}: the sensor is reversed.\n"
        "The scale is that of readings in m; multiply it by the m per unit of your card."
    )
    dump(path, "servo", {"sensor_scale": -1.0}, comment)
    return path


def show(console: Console, title: str, fits: dict[str, FitQuality]) -> None:
    """Print the figures of fits as a table."""
    table = Table(title=title)
    for heading in ("", "rms µm", "max µm", "stroke µm", "rms %", "max %", "left %"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, fit in fits.items():
        lengths = (f"{value * 1e6:.4g}" for value in (fit.rms, fit.maximum, fit.stroke))
        left = "" if np.isnan(fit.share) else f"{100.0 * fit.share:.1f}"
        table.add_row(name, *lengths, f"{fit.rms_percent:.3f}", f"{fit.maximum_percent:.2f}", left)
    console.print(table)


def figures(fit: FitQuality) -> dict[str, float]:
    """Return the figures of a fit for JSON: m, % of the stroke, share of what less of a model leaves."""
    compared = {} if np.isnan(fit.share) else {"share": fit.share}
    return {
        "rms": fit.rms,
        "maximum": fit.maximum,
        "stroke": fit.stroke,
        **compared,
        "rms_percent": fit.rms_percent,
        "maximum_percent": fit.maximum_percent,
    }


def parse(words: Sequence[str] | None) -> argparse.Namespace:
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
        "--sensor-delay",
        type=within(int, 0, 1000),
        default=1,
        metavar="SAMPLES",
        help="age of a deflection (1)",
    )
    reading.add_argument(
        "--out",
        "-o",
        type=output_folder,
        default="out/identified",
        help="folder (out/identified)",
    )
    for name, default, text in (
        ("--start", 0.0, "use from here on"),
        ("--end", np.inf, "use up to here"),
    ):
        reading.add_argument(name, type=within(float, 0.0), default=default, metavar="S", help=text)

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
    fit.add_argument(
        "--plays", type=within(int, 1, 1000), default=20, metavar="N", help="equal thresholds (20)"
    )
    fit.add_argument("--thresholds", type=volts, metavar="V,V,...", help="thresholds instead")
    fit.add_argument(
        "--dead-zones", type=within(int, 0, 100), default=3, metavar="N", help="on either side (3)"
    )
    fit.add_argument(
        "--lag", type=seconds, metavar="S",
        help="lag of the deflection, or 'identify'; default: known of bags, 'identify' for text files",
    )  # fmt: skip
    fit.add_argument(
        "--skip", type=within(int, 0), metavar="SAMPLES",
        help="not fitted; default: until the voltage has been to both ends",
    )  # fmt: skip
    fit.add_argument(
        "--hold-back",
        type=within(float, 0.0, 0.9),
        default=0.3,
        metavar="SHARE",
        help="of the samples (0.3)",
    )
    command(check).add_argument("--skip", type=within(int, 0), metavar="SAMPLES", help="not judged")
    command(dynamics).add_argument(
        "--modes", type=within(int, 1, 6), default=3, metavar="N",
        help="so many at most (3); those are kept that the recording is evidence for",
    )  # fmt: skip
    command(stiffness)
    command(drift, several=True)
    return parser.parse_args(words)


def seconds(text: str) -> float | str:
    """Return a number of seconds, or the word 'identify'."""
    return text if text == "identify" else within(float, -1e3, 1e3)(text)


def volts(text: str) -> tuple[float, ...]:
    """Return the numbers of a list like '0,3,6'."""
    return tuple(float(entry) for entry in text.split(","))
