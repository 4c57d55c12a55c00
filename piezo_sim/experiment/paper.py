# SPDX-License-Identifier: Apache-2.0
"""The paper's figures and specification against what was measured here: one table.

Source of what the paper asks and shows: Rakotondrabe, Diouf, Lutz (IFAC 2008). A line that the paper
draws but does not number ("weakly affects", "negligible") has a limit of this project's own, shown in
the column of what is asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from piezo_control.metrics import bandwidth
from piezo_control.report.page import Section
from piezo_sim.experiment.analysis import frequency_response
from piezo_sim.experiment.results import Result

Values = list[float]
SPECIFICATION = "Specification: "


@dataclass(frozen=True)
class Claim:
    """One line of the table.

    `value` finds the figures, one per temperature, in the results of one controller (or of the runs
    without feedback); they are met when all lie from `low` to `high`. `paper_met` is None where the
    paper does not say.
    """

    quantity: str
    asked: str
    paper: str
    paper_met: bool | None
    value: Callable[[Sequence[Result]], Values]
    digits: int
    low: float = -math.inf
    high: float = math.inf
    is_closed_loop: bool = False


def of(analysis: str, quantity: str, scale: float = 1.0) -> Callable[[Sequence[Result]], Values]:
    """Return a finder of a quantity of all results with this analysis, in the order of the cases."""

    def find(results: Sequence[Result]) -> Values:
        found = [r.figures[quantity] for r in results if r.run.case.analysis == analysis]
        return [math.nan if value is None else value * scale for value in found]

    return find


def transient_change(results: Sequence[Result]) -> Values:
    """Return the largest difference of the transients at two temperatures, in % of the final value."""
    scaled = [
        r.recording.deflection * 1e6 / r.figures["final_um"]
        for r in results
        if r.run.case.analysis == "transient"
    ]
    return [float(np.max(np.abs(other - scaled[0]))) * 100 for other in scaled[1:]]


def growth(
    analysis: str, quantity: str, is_ratio: bool = False
) -> Callable[[Sequence[Result]], Values]:
    """Return a finder of the change of a quantity from the first temperature to the others."""

    def find(results: Sequence[Result]) -> Values:
        first, *others = of(analysis, quantity)(results)
        return [value / first if is_ratio else value - first for value in others]

    return find


def magnitude_change(results: Sequence[Result]) -> Values:
    """Return the largest difference in dB, up to the cut-off, of the magnitude at two temperatures."""
    bands: dict[float | int | None, list[Result]] = {}
    for r in results:
        if r.run.case.analysis == "frequency":
            bands.setdefault(r.figures["lowest_rad_s"], []).append(r)
    worst = 0.0
    for first, *others in bands.values():
        response = frequency_response(first.recording)
        inside = response.frequency <= bandwidth(response)
        for other in others:
            change = frequency_response(other.recording).magnitude_db - response.magnitude_db
            worst = max(worst, float(np.max(np.abs(change[inside]))))
    return [worst]


def cut_off(results: Sequence[Result]) -> Values:
    """Return the −3 dB frequencies (rad/s) of the records that contain it."""
    return [value for value in of("frequency", "bandwidth_rad_s")(results) if math.isfinite(value)]


def spotlight(results: Sequence[Result]) -> Values:
    """Return the change of deflection (µm) per 10 °C under the spotlight."""
    return of("thermal", "rejection_um_per_degc", 10.0)(
        [r for r in results if r.run.case.experiment == "thermal"]
    )


ROUNDING = 1e-9
"""Readings are whole steps of the sensor, so a figure may be its limit but for the last digit."""

CLAIMS = (
    Claim("Fig. 3: vibration after a 40 V step [Hz]", "660 to 673", "666.6, D(s)", True,
          of("transient", "ringing_hz"), 1, 660.0, 673.0),
    Claim("Fig. 3: damping ratio", "0.0165 to 0.0175", "0.017, D(s)", True,
          of("transient", "damping_ratio"), 4, 0.0165, 0.0175),
    Claim("Fig. 3: transient at 32 against 22 °C, final values made equal [%]", "unchanged: ≤ 2",
          "unchanged", True, transient_change, 2, high=2.0),
    Claim("Fig. 3: final deflection [µm]", "27 to 33", "about 30", True,
          of("transient", "final_um"), 1, 27.0, 33.0),
    Claim("Fig. 4: creep from 1 s to 300 s, at 32 against 22 °C [times]", "highly amplified: ≥ 5",
          "highly amplified", True, growth("creep", "creep_um", is_ratio=True), 1, low=5.0),
    Claim("Fig. 4: creep at 22 / 32 °C [µm]", "–", "negligible / large", None,
          of("creep", "creep_um"), 2),
    Claim("Fig. 5: peak to peak at ±40 V, 1 Hz [µm]", "about 44: 40 to 48", "about 44", True,
          of("hysteresis", "peak_to_peak_um"), 1, 40.0, 48.0),
    Claim("Fig. 5: width of the loop [% of peak to peak]", "–", "not given", None,
          of("hysteresis", "loop_width_percent"), 1),
    Claim("Fig. 5: width at 32 less that at 22 °C [points]", "weakly affected: within ±2",
          "weakly affected", True, growth("hysteresis", "loop_width_percent"), 2, -2.0, 2.0),
    Claim("Fig. 9: slope at 22 / 32 °C", "–", "1 / another one", None,
          of("feedforward", "slope"), 4),
    Claim("Fig. 9: slope at 22 °C", "1: 0.99 to 1.01", "1", True,
          lambda results: of("feedforward", "slope")(results)[:1], 4, 0.99, 1.01),
    Claim("Fig. 9: change of the slope at 32 °C", "visible: ≥ 0.02", "visible", True,
          growth("feedforward", "slope"), 4, low=0.02),
    Claim("Fig. 9: loop left over [% of peak to peak]", "a line to the eye: ≤ 1", "a line", True,
          of("feedforward", "loop_width_percent"), 2, high=1.0),
    Claim("Fig. 13: settling to 5 % [ms]", "≤ 15, as shown", "< 15", True,
          of("step", "settling_time_5pct_ms"), 1, high=15.0, is_closed_loop=True),
    Claim("Specification: response time, to 5 % [ms]", "≤ 10", "< 15", False,
          of("step", "settling_time_5pct_ms"), 1, high=10.0, is_closed_loop=True),
    Claim("Specification: overshoot [%]", "null: ≤ 0.15 (30 nm of noise)", "null", True,
          of("step", "overshoot_percent"), 2, high=0.15, is_closed_loop=True),
    Claim("Specification: static error [%]", "≤ 0.05", "0.68, from the printed K", False,
          of("step", "static_error_percent"), 3, high=0.05, is_closed_loop=True),
    Claim("Specification: thermal disturbance, spotlight [µm per 10 °C]", "≤ 0.5", "not measured",
          None, spotlight, 3, high=0.5, is_closed_loop=True),
    Claim("Fig. 14: cut-off, −3 dB [rad/s]", "about 200: ≥ 180", "about 200", True,
          cut_off, 0, low=180.0, is_closed_loop=True),
    Claim("Fig. 14: magnitude at 32 against 22 °C, up to the cut-off [dB]", "similar: ≤ 1", "similar",
          True, magnitude_change, 2, high=1.0, is_closed_loop=True),
    Claim("1 mN on the tip: largest deviation [µm]", "–", "not shown", None,
          of("force", "deflection_change_um"), 2, is_closed_loop=True),
    Claim("1 mN on the tip: recovery to 5 % [ms]", "–", "not shown", None,
          of("force", "recovery_ms"), 1, is_closed_loop=True),
)  # fmt: skip


def compare(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return the lines of the table: texts, values per column ('open loop' or controller), verdicts."""
    controllers = _controllers(results)
    return [
        _line(claim, results, controllers if claim.is_closed_loop else ["none"]) for claim in CLAIMS
    ]


def _line(claim: Claim, results: Sequence[Result], columns: Sequence[str]) -> dict[str, Any]:
    values = {c: claim.value([r for r in results if r.run.case.controller == c]) for c in columns}
    has_limit = math.isfinite(claim.low) or math.isfinite(claim.high)
    met = {
        c: all(claim.low - ROUNDING <= v <= claim.high + ROUNDING for v in found)
        if has_limit and found
        else None
        for c, found in values.items()
    }
    return {
        "quantity": claim.quantity,
        "asked": claim.asked,
        "paper": claim.paper,
        "paper_met": claim.paper_met,
        "values": values,
        "met": met,
        "digits": claim.digits,
    }


def verdict(results: Sequence[Result]) -> list[str]:
    """Return a sentence for each controller: what of the paper's specification it meets and misses."""
    controllers = _controllers(results)
    claims = [claim for claim in CLAIMS if claim.quantity.startswith(SPECIFICATION)]
    lines = [_line(claim, results, controllers) for claim in claims]
    sentences = []
    for c in controllers:
        said: dict[bool, list[str]] = {True: [], False: []}
        for line in lines:
            if line["met"][c] is not None:
                quantity, unit = (
                    line["quantity"].removeprefix(SPECIFICATION).rstrip("]").split(" [")
                )
                figure = f"{quantity} is {_cell(line['values'][c], line['digits'])} {unit}"
                said[line["met"][c]].append(f"{figure}, asked {line['asked']}")
        name = f"The {_name(c)}" if c == "paper" else f"'{c}'"
        if said[False]:
            sentences.append(f"{name} misses the paper's specification: {'; '.join(said[False])}.")
        elif said[True]:
            sentences.append(f"{name} meets the paper's specification: {'; '.join(said[True])}.")
    return sentences


def section(results: Sequence[Result]) -> Section:
    """Return the table as a section of the report."""
    controllers = _controllers(results)
    headings = [
        "quantity", "asked for or shown", "paper", *(f"here, {_name(c)}" for c in controllers),
        "met or missed",
    ]  # fmt: skip
    rows = []
    for line in compare(results):
        cells = {c: _cell(found, line["digits"]) for c, found in line["values"].items()}
        columns = [cells.get(c) or cells["none"] for c in controllers]
        verdicts = [("paper", line["paper_met"])]
        verdicts += [(_name(c) if c != "none" else "here", v) for c, v in line["met"].items()]
        said = [f"{who} {'met' if v else 'missed'}" for who, v in verdicts if v is not None]
        rows.append(
            [line["quantity"], line["asked"], line["paper"], *columns, ", ".join(said) or "–"]
        )
    return Section(
        "The paper against this project",
        "Two values in a cell are those at 22 and at 32 °C. The first lines are without feedback, so "
        "the controller makes no difference there. Limits without a number in the paper are this "
        "project's own.",
        columns=headings,
        rows=rows,
    )


def _controllers(results: Sequence[Result]) -> list[str]:
    return list(
        dict.fromkeys(r.run.case.controller for r in results if r.run.case.mode == "feedback")
    )


def _name(controller: str) -> str:
    return "paper's K" if controller == "paper" else controller


def _cell(values: Values, digits: int) -> str:
    return " / ".join("never" if math.isnan(v) else f"{v:.{digits}f}" for v in values) or "–"
