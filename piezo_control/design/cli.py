# SPDX-License-Identifier: Apache-2.0
"""From a design problem in YAML to a certified controller for `feedback`.

The problem is a ROS parameter file for the node name `synthesize`: finger, uncertainty,
specifications, and either weights or nothing, in which case they are found from the specifications.
The controller is written only when the recomputed closed loop meets every specification (or with
--force, and then says that it is not certified). With --cantilever, a finger of which a block was neither
identified nor written by hand is refused, unless --assume says that the paper's may stand for it. Next to it, into --report: certificate.json, the
complete problem with everything that was found, pictures, and a page (HTML) of all to zoom in.

Exit code: 0 certified, 1 not certified, 2 unusable input or a problem without a solution.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# Many small matrices: the threads of BLAS, started with numpy, would make the search ten times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from rich import box  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from piezo_control.design import plots as design_plots  # noqa: E402
from piezo_control.design.certificate import Certificate, Row, certify  # noqa: E402
from piezo_control.design.problem import DesignProblem, SynthesisError  # noqa: E402
from piezo_control.design.synthesis import synthesize  # noqa: E402
from piezo_control.feedback import FeedbackParameters  # noqa: E402
from piezo_control.files import write_json  # noqa: E402
from piezo_control.hysteresis import (  # noqa: E402
    HysteresisParameters,
    coefficients,
    reachable_range,
)
from piezo_control.options import output_file, output_folder  # noqa: E402
from piezo_control.parameters import (  # noqa: E402
    ParameterError,
    T,
    build,
    declarations,
    dump,
    flatten,
    load,
)
from piezo_control.report.page import Section, write_html  # noqa: E402
from piezo_control.safety import VoltageParameters  # noqa: E402
from piezo_control.shared import shared_folder  # noqa: E402
from piezo_control.thermal import ThermalParameters  # noqa: E402


def main() -> int:
    """Run the command line and return its exit code."""
    arguments = parse()
    console = Console()
    begin = time.perf_counter()
    try:
        problem = read_problem(arguments.problem, arguments.cantilever)
        origin = finger_origin(arguments.problem, arguments.cantilever, arguments.assume)
        out = arguments.out or Path(f"feedback_{problem.name}.yaml")
        if out.exists() and not arguments.overwrite:
            raise ParameterError(f"{out} exists; name a new --out or give --overwrite")
        design = synthesize(problem)
    except ParameterError as error:
        print(f"synthesize: {error}", file=sys.stderr)
        return 2
    except SynthesisError as error:
        print(f"synthesize: {arguments.problem}: {error}", file=sys.stderr)
        return 2
    certificate = certify(design.problem, design.controller, design.gamma)
    show(console, certificate)
    console.print(origin, highlight=False, markup=False)
    report = arguments.report or Path("out", "synthesize", problem.name)
    written = write_report(report, design.problem, design.controller, certificate, origin)
    if certificate.met or arguments.force:
        controller = dataclasses.replace(design.controller, certified=certificate.met)
        out.parent.mkdir(parents=True, exist_ok=True)
        head = comment(certificate, arguments.problem)
        dump(out, "feedback", flatten(controller), f"{head}\n{origin}")
        written.append(out)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True)
    console.print(f"took {time.perf_counter() - begin:.1f} s")
    if not certificate.met:
        hint = "" if arguments.force else f". {out} is only written with --force"
        print(f"synthesize: {shortfall(certificate, problem)}{hint}", file=sys.stderr)
    return 0 if certificate.met else 1


def shortfall(certificate: Certificate, problem: DesignProblem) -> str:
    """Say how far the worst fingers are from what is required, which ones they are, and which times are short."""

    def distance(row: Row) -> str:
        unit = f" {row.unit}" if row.unit else ""
        where = f" ({row.at})" if row.at else ""
        return f"{row.specification} {row.worst:.4g}{unit}, required {row.relation} {row.required:.4g}{unit}{where}"

    missed = "; ".join(distance(row) for row in certificate.rows if not row.met)
    return f"NOT certified. The best design found: {missed}{short_times(problem)}"


def short_times(problem: DesignProblem) -> str:
    """Say which times are few periods of the finger's resonance, and what is usual; '' for none.

    A loop's times go with the period, so that what is asked of a quick finger no slower one reaches.
    """
    robust = read_problem(shared_folder() / "params" / "synthesis_robust.yaml")
    period, its_period = (
        2.0 * math.pi * math.sqrt(p.finger.denominator[0]) for p in (problem, robust)
    )
    found = []
    for name in ("settling_time", "force_settling_time"):
        asked, its_time = (getattr(p.specification, name) for p in (problem, robust))
        usual = its_time / its_period
        if 0.0 < asked < 0.95 * usual * period:
            found.append(
                f"{name} is {asked:g} s, {asked / period:.2g} periods of the resonance of {1.0 / period:.4g} Hz, where "
                f"`robust` has {usual:.3g}, here {usual * period:.3g} s"
            )
    return "".join(f"; {text}" for text in found)


BLOCKS = {
    "dynamics": ("dynamics.denominator",),
    "hysteresis": ("hysteresis.weights",),
    "limits": ("amplifier.voltage_low", "amplifier.voltage_high"),
}
"""What a certificate rests upon, and the parameters of a cantilever that say it."""
BESIDE = {
    "heat": ("thermal.sensitivity",),
    "delay": ("sensor.delay_samples",),
    "sample time": ("sample_time",),
    "amplifier's lag": ("amplifier.bandwidth_hz",),
}
"""What it rests upon, too, and may do without, when it says so."""
ASSUMED = "ASSUMED, the paper's"


def finger_origin(problem: Path, cantilever: Path | None, assume: Sequence[str] = ()) -> str:
    """Return lines that say where the finger of a design comes from, block by block.

    Raises ParameterError naming file and blocks when a block of `cantilever` is missing, so that the paper's
    finger would take its place, and is not one of `assume`.
    """
    if cantilever is None:
        return f"finger: as {problem.name} has it, and the paper's where it says nothing"
    said = load(cantilever, "cantilever")
    missing = [block for block, names in BLOCKS.items() if not all(name in said for name in names)]
    refused = [block for block in missing if block not in assume]
    if refused:
        raise ParameterError(
            f"{cantilever}: says nothing of {', '.join(refused)} of this finger, so a certificate would be of "
            f"the paper's: `identify dynamics` and `identify hysteresis` find the first two, {BLOCKS['limits'][0]} "
            f"and {BLOCKS['limits'][1]} are yours to write; or --assume {' '.join(refused)}"
        )
    lines = [
        f"finger, {block}: " + (f"from {cantilever}" if all(n in said for n in names) else ASSUMED)
        for block, names in (BLOCKS | BESIDE).items()
    ]
    # What `identify` and `commission` say of their fits.
    lines += [line[2:] for line in cantilever.read_text().splitlines() if line.startswith("# ")]
    return "\n".join(lines)


def read_problem(path: Path, cantilever: Path | None = None) -> DesignProblem:
    """Read a design problem; all that depends on the finger from `cantilever` when given.

    That is D(s), higher modes, the amplifier's lag, sample time and sensor delay, the reach within the limits of the voltage, and how far a
    degree moves the tip: by the thermal deflection, and by the change of the stroke at the end of the reach.

    Raises ParameterError naming file and value.
    """
    values = load(path, "synthesize")
    if cantilever is not None:
        identified = load(cantilever, "cantilever")
        names = {
            "dynamics.denominator": "finger.denominator",
            "modes.frequency_hz": "finger.modes.frequency_hz",
            "modes.damping": "finger.modes.damping",
            "modes.share": "finger.modes.share",
            "amplifier.bandwidth_hz": "finger.amplifier_bandwidth_hz",
            "sample_time": "finger.sample_time",
            "sensor.delay_samples": "finger.delay_samples",
            "thermal.time_constant": "finger.drift_time_constant",
        }
        values.update(
            {ours: identified[theirs] for theirs, ours in names.items() if theirs in identified}
        )
        values.update(_of_reach_and_heat(identified, str(cantilever)))
    return build(DesignProblem, values, str(path))


def _of_reach_and_heat(identified: Mapping[str, Any], source: str) -> dict[str, float]:
    """Return command range and drift of a finger from the parameters of its cantilever."""

    def part(cls: type[T], name: str) -> T:
        known = declarations(cls)
        values = {n: identified[f"{name}.{n}"] for n in known if f"{name}.{n}" in identified}
        return build(cls, values, source)

    voltage = part(VoltageParameters, "amplifier")
    operator = coefficients(part(HysteresisParameters, "hysteresis"), sample_time=1.0)
    low, high = reachable_range(operator, voltage.voltage_low, voltage.voltage_high)
    thermal = part(ThermalParameters, "thermal")
    drift = abs(thermal.sensitivity) + abs(thermal.gain_per_degc) * max(-low, high)
    return {
        "finger.command_low": low,
        "finger.command_high": high,
        "finger.drift_per_degc": drift,
    }


def write_report(
    folder: Path,
    problem: DesignProblem,
    controller: FeedbackParameters,
    certificate: Certificate,
    origin: str,
) -> list[Path]:
    """Write certificate, complete problem, pictures and a page of all; return their paths. `origin` is the finger's."""
    folder.mkdir(parents=True, exist_ok=True)
    content = {**certificate.as_dict(), "origin": origin.splitlines()}
    as_json = write_json(folder / "certificate.json", content)
    solved = folder / "problem.yaml"
    dump(
        solved,
        "synthesize",
        flatten(problem),
        f"Design problem of '{problem.name}', nothing left open.",
    )
    pictures = design_plots.draw(problem, controller, certificate, folder)
    rows = [cells(row) for row in certificate.rows]
    drawn = [(picture, picture.stem) for picture in pictures]
    page = write_html(
        folder / "certificate.html",
        title(certificate),
        [
            Section("Certificate", summary(certificate), columns=HEADINGS, rows=rows),
            Section("The loops of the box", origin, drawn),
        ],
    )
    return [as_json, solved, *pictures, page]


HEADINGS = ("specification", "required", "nominal", "worst case", "met", "worst at")
NUMERIC = HEADINGS[1:4]


def cells(row: Row) -> tuple[str, ...]:
    """Return a line of the certificate as text, one entry per heading."""
    label = f"{row.specification}, {row.unit}" if row.unit else row.specification
    required = f"{row.relation} {row.required:.4g}"
    return (
        label, required, f"{row.nominal:.4g}", f"{row.worst:.4g}", "yes" if row.met else "NO", row.at
    )  # fmt: skip


def title(certificate: Certificate) -> str:
    """Return name and verdict of a certificate."""
    return f"{certificate.name}: {'certified' if certificate.met else 'NOT certified'}"


def show(console: Console, certificate: Certificate) -> None:
    """Print the certificate as a table, and the figures that nothing is required of."""
    table = Table(title=title(certificate), box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in HEADINGS[:-1]:
        table.add_column(heading, justify="right" if heading in NUMERIC else "left")
    for row in certificate.rows:
        table.add_row(*cells(row)[:-1], style="" if row.met else "red")
    console.print(table)
    console.print(summary(certificate))


def summary(certificate: Certificate) -> str:
    """Return margins, bandwidth and stable range in words."""
    n, w, o = certificate.nominal, certificate.worst, certificate.outer
    return (
        f"margins, nominal (worst): gain {n['gain_up']:.3g} ({w['gain_up']:.3g}), phase "
        f"{n['phase_deg']:.0f} ({w['phase_deg']:.0f}) deg, delay {1e3 * n['delay_s']:.2g} "
        f"({1e3 * w['delay_s']:.2g}) ms\n"
        f"-3 dB at {n['bandwidth']:.4g} rad/s, static sensitivity {n['sensitivity_static']:.2g}\n"
        f"noise gain {n['noise_gain']:.3g} ({w['noise_gain']:.3g}), largest |K| above the modelled band "
        f"{n['feedback_above']:.2g}, overshoot between samples {100 * n['intersample']:.2g} "
        f"({100 * w['intersample']:.2g}) %\n"
        f"peaks, nominal (worst): |T| {n['complementary_peak']:.3g} ({w['complementary_peak']:.3g}), "
        f"|G S| {n['disturbance_peak']:.3g} ({w['disturbance_peak']:.3g})\n"
        f"nominally stable for resonances from {100 * (n['resonance_low'] - 1):+.1f} to "
        f"{100 * (n['resonance_high'] - 1):+.1f} % (searched -60 to +60 %)\n"
        f"in the wider box: 5 % settling {1e3 * o['settling']:.3g} ms, overshoot "
        f"{100 * o['overshoot']:.2g} %, Ms {o['sensitivity_peak']:.3g}"
    )


def comment(certificate: Certificate, source: Path) -> str:
    """Return the head of the controller's file: verdict and table."""
    verdict = "Certified: every specification is met by the recomputed closed loop."
    if not certificate.met:
        verdict = "NOT CERTIFIED, written with --force: see the lines with NO."
    lines = [HEADINGS, *(cells(row) for row in certificate.rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEADINGS))]
    table = (
        "  ".join(
            cell.rjust(width) if heading in NUMERIC else cell.ljust(width)
            for heading, cell, width in zip(HEADINGS, line, widths)
        ).rstrip()
        for line in lines
    )
    return "\n".join(
        [
            f"Controller '{certificate.name}', by `synthesize {source.name}`. {verdict}",
            *table,
            summary(certificate),
        ]
    )


def parse() -> argparse.Namespace:
    """Return the command line's arguments."""
    parser = argparse.ArgumentParser(
        prog="synthesize", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a controller in --out")
    parser.add_argument(
        "problem", type=Path, help="design problem, e.g. params/synthesis_robust.yaml"
    )
    parser.add_argument(
        "--out", type=output_file, help="controller to write (feedback_<name>.yaml in this folder)"
    )
    parser.add_argument(
        "--report",
        type=output_folder,
        help="folder of certificate and pictures (out/synthesize/<name>)",
    )
    parser.add_argument(
        "--cantilever",
        type=Path,
        help="parameter file of the cantilever, as `identify` writes it: its D(s), modes, amplifier, sample "
        "time, delay and thermal lag instead of the problem's",
    )
    parser.add_argument(
        "--assume", nargs="+", default=[], choices=BLOCKS, metavar="BLOCK",
        help=f"with --cantilever: take the paper's for these, if it says nothing: {', '.join(BLOCKS)}",
    )  # fmt: skip
    parser.add_argument(
        "--force", action="store_true", help="write the controller though it is not certified"
    )
    return parser.parse_args()
