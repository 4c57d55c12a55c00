# SPDX-License-Identifier: Apache-2.0
"""The table of all shipped controllers: its linear figures are the certificates', its runs the finger's."""

import itertools
import re

import pytest
from rich.progress import Progress

from piezo_control.shared import shared_folder
from piezo_sim.experiment import baselines


@pytest.fixture(scope="module")
def linear():
    return baselines.margins_of(baselines.CONTROLLERS)


def test_figures_of_the_linear_loop_are_those_that_its_certificate_says(linear):
    """From the comment of the shipped file: nominal and worst, on a finer box than the table's."""
    text = (shared_folder() / "params" / "feedback_robust.yaml").read_text()

    def certified(label):
        nominal, worst = re.search(
            rf"# {re.escape(label)} +[≤<] [\d.]+ +([\d.]+) +([\d.]+)", text
        ).groups()
        return float(nominal), float(worst)

    for ours, theirs in (
        ("Ms", "sensitivity peak Ms"),
        ("effort |K S|", "effort peak |K S|"),
        ("noise gain", "noise gain, readings to command"),
        ("second mode |K S| W", "unmodelled modes, |K S| W"),
    ):
        found = [float(value) for value in linear["robust"][ours].split(" / ")]
        assert found == pytest.approx(certified(theirs), abs=0.02), ours
    delay = re.search(r"delay ([\d.]+) \(([\d.]+)\) ms", text).groups()
    found = [float(value) for value in linear["robust"]["delay margin [ms]"].split(" / ")]
    assert found == pytest.approx([float(value) for value in delay], abs=0.02)


def test_the_papers_controller_is_not_stable_on_every_finger_of_the_box(linear):
    """Its zeros cancel the nominal resonance."""
    assert all(cell.endswith("/ unstable") for cell in linear["paper"].values())
    assert "unstable" not in "".join(linear["robust"].values())


def test_one_column_of_the_table_step_and_sines_cold_and_warm(monkeypatch, tmp_path):
    monkeypatch.setattr(baselines, "CONTROLLERS", ("robust",))
    monkeypatch.setattr(baselines, "PREVIEWED", ("robust, preview",))
    with Progress(disable=True) as progress:
        section = baselines.study(tmp_path, {"prandtl_ishlinskii": None}, progress)
    assert section.columns == ["figure", "robust", "robust, preview"]
    rows = {
        row[0]: [list(map(float, cell.split(" / "))) for cell in row[1:]] for row in section.rows
    }
    plain, ahead = rows["prandtl_ishlinskii: 10 Hz, largest error [%]"]
    assert min(plain) > 12.0  # of the amplitude: the loop runs after
    assert ahead[0] <= 1.0 and ahead[1] <= 2.0
    plain, ahead = rows["prandtl_ishlinskii: 100 Hz, largest error [%]"]
    assert min(plain) > 90.0 and ahead[0] <= 5.0
    settling, _ = rows["prandtl_ishlinskii: settling [ms]"]
    assert max(settling) <= 6.0  # what 'robust' is certified for


def test_what_follows_a_model_runs_with_the_temperature_undone(monkeypatch, tmp_path):
    """The figures that are asked of the two, nominally 2.5 ms with the smaller box, at 32 °C too; preview 1, 5, 2 %."""
    monkeypatch.setattr(baselines, "CONTROLLERS", ("robust", "following", "following_adapted"))
    monkeypatch.setattr(baselines, "PREVIEWED", ("following, preview",))
    monkeypatch.setattr(baselines, "HERTZ", (10.0, 100.0))
    with Progress(disable=True) as progress:
        section = baselines.study(tmp_path, {"prandtl_ishlinskii": None}, progress)
    rows = {
        row[0]: [list(map(float, cell.split(" / "))) for cell in row[2:]] for row in section.rows
        if row[0].startswith("prandtl")
    }  # fmt: skip
    settling, overshoot, tenth, hundredth = (
        rows[f"prandtl_ishlinskii: {label}"]
        for label in (
            "settling [ms]", "overshoot [%]", "10 Hz, largest error [%]", "100 Hz, largest error [%]",
        )
    )  # fmt: skip
    assert max(settling[0]) <= 4.0 and max(settling[1]) <= 2.5
    assert max(itertools.chain(*overshoot)) <= 0.5
    assert max(tenth[-1]) <= 1.0 and max(hundredth[-1]) <= 5.0
