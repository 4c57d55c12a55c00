# SPDX-License-Identifier: Apache-2.0
"""The safety page says what the code does: defaults are the parameters', every row of faults has its test."""

from pathlib import Path

import pytest
import test_gripper
import test_node_faults
import test_nodes
import test_safety

from piezo_control.nodes.parameters import FeedforwardNodeParameters
from piezo_sim.nodes.parameters import CantileverNodeParameters

PAGE = (Path(__file__).parents[1] / "docs" / "safety.md").read_text()
FEEDFORWARD, CANTILEVER = FeedforwardNodeParameters(), CantileverNodeParameters()


def number(text: str) -> float:
    """Return the number at the start of a cell such as '−40 to 40 V'."""
    return float(text.split()[0].replace("−", "-"))


def cell(parameter: str) -> str:
    (line,) = (x for x in PAGE.splitlines() if f"| `{parameter}`" in x and x.count("|") == 5)
    return line.split("|")[3].strip()


@pytest.mark.parametrize(
    "parameter, value",
    [
        ("voltage_low`, `voltage_high", FEEDFORWARD.voltage_low),
        ("slew_limit", FEEDFORWARD.slew_limit),
        ("amplifier.slew_limit", CANTILEVER.amplifier.slew_limit),
        ("rest_voltage", FEEDFORWARD.rest_voltage),
        ("ramp", FEEDFORWARD.ramp),
        ("hold_time", FEEDFORWARD.hold_time),
        ("reply_timeout", CANTILEVER.reply_timeout),
        ("age_limit", FEEDFORWARD.age_limit),
    ],
)
def test_figures_of_the_page_are_the_defaults(parameter, value):
    assert number(cell(parameter)) == pytest.approx(value)


def test_symmetric_default():
    assert FEEDFORWARD.voltage_high == -FEEDFORWARD.voltage_low == 40.0
    assert (CANTILEVER.ramp, CANTILEVER.hold_time) == (FEEDFORWARD.ramp, FEEDFORWARD.hold_time)


def test_every_row_of_faults_is_shown_by_a_test_and_every_such_test_has_a_row():
    table = PAGE.split("| what is seen |")[1].split("\n\n")[0].splitlines()[2:]
    rows = {line.split("|")[1].strip() for line in table}
    marks = [
        mark
        for module in (test_gripper, test_node_faults, test_nodes, test_safety)
        for test in vars(module).values()
        for mark in getattr(test, "pytestmark", [])
    ]
    assert rows == {row for mark in marks if mark.name == "shows" for row in mark.args}
