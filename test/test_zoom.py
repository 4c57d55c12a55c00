# SPDX-License-Identifier: Apache-2.0
"""The curves of a report's pictures, for a browser: what they keep of long ones, and that a page draws them offline."""

import base64
import gzip
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezo_control.design import cli as design
from piezo_control.design.certificate import certify
from piezo_control.feedback import read_controller
from piezo_control.identification import cli as identification
from piezo_control.report import pictures
from piezo_control.report.page import Section, write_html
from piezo_sim.experiment.cases import params_folder

needs_bokeh = pytest.mark.skipif(not pictures.HAS_BOKEH, reason="Bokeh is not installed")


@given(st.integers(1, 30_000), st.integers(0, 2**32 - 1))
def test_no_peak_of_a_long_curve_is_lost(size, seed):
    y = np.random.default_rng(seed).normal(size=size)
    shown = pictures.thinned(y)
    assert len(shown) <= pictures.POINTS + 2
    assert (np.diff(shown) > 0).all() and shown[0] == 0 and shown[-1] == size - 1
    assert (y[shown].min(), y[shown].max()) == (y.min(), y.max())
    if size <= pictures.POINTS:
        assert len(shown) == size


def drawn(path):
    """A picture with all that ours have: curves, straight lines, marks, bars of errors, a histogram; logarithmic axes."""
    from piezo_sim.experiment import plots

    figure, (left, right, bars, counts) = plots.plt.subplots(1, 4)
    left.plot([0.0, 1.0, 2.0], [1.0, -2.0, 5.0], label="tip")
    left.axhline(3.0)
    left.axvline(0.5)
    left.axline((1.0, 2.0), slope=0.5)
    left.set_title("loop")
    right.semilogx([1.0, 10.0, 100.0], [0.0, -3.0, -20.0], label="gain")
    bars.errorbar([1.0, 2.0], [10.0, 20.0], [0.5, 1.0], fmt="x")
    counts.hist([1.0, 1.0, 3.0], 2, histtype="step", log=True, label="periods")
    return plots.save(figure, path)


def values(entry):
    """The numbers that Bokeh wrote, lists of them too."""
    if isinstance(entry, list):
        return [values(part) for part in entry]
    packed = base64.b64decode(entry["array"]["data"])
    return np.frombuffer(gzip.decompress(packed), entry["dtype"]).tolist()


@needs_bokeh
def test_what_a_picture_shows_is_what_a_browser_gets(tmp_path):
    plot = json.loads(pictures.plot_file(drawn(tmp_path / "a.png")).read_text())
    models = []

    def collect(value):
        if isinstance(value, dict):
            models.append(value)
        for entry in value.values() if isinstance(value, dict) else value:
            if isinstance(entry, (dict, list)):
                collect(entry)

    collect(plot)
    named = {}
    for model in models:
        named.setdefault(model.get("name"), []).append(model.get("attributes", {}))
    assert {(s.get("dimension", "width"), s["location"]) for s in named["Span"]} == {
        ("width", 3.0),
        ("height", 0.5),
    }
    (slope,) = named["Slope"]
    assert (slope["gradient"], slope["y_intercept"]) == (0.5, 1.5)
    assert len(named["Line"]) >= 2 and "LogAxis" in named
    drawn_as = [{n: values(v) for n, v in s["data"]["entries"]} for s in named["ColumnDataSource"]]
    assert {"x": [0.0, 1.0, 2.0], "y": [1.0, -2.0, 5.0]} in drawn_as
    assert {"xs": [[1.0, 1.0], [2.0, 2.0]], "ys": [[9.5, 10.5], [19.0, 21.0]]} in drawn_as
    assert {"x": [1.0, 2.0], "y": [10.0, 20.0]} in drawn_as and "Scatter" in named
    (steps,) = (d for d in drawn_as if d.get("x", [])[::2] == [1.0, 2.0, 3.0])
    assert steps["y"][1:-1] == [2.0, 2.0, 1.0, 1.0] and min(steps["y"]) > 0.0


def a_report(folder, monkeypatch):
    return report_of(folder, drawn(folder / "a.png"))


def report_of(folder, picture):
    return write_html(folder / "report.html", "A report", [Section("One", figures=[(picture, "")])])


def of_servo(folder, monkeypatch):
    from piezo_sim.experiment.on_nodes import servo

    time = 1e-4 * np.arange(400)
    step = np.where(time > 0.01, servo.STEP, 0.0)
    recording = SimpleNamespace(time=time, reference=step, deflection=step)
    return report_of(folder, servo.draw(recording, np.full(400, 3e-6), folder / "servo.png"))


def of_identify(folder, monkeypatch):
    time = np.arange(3000) * 1e-3
    voltage = 25.0 * np.sin(2 * np.pi * time) * np.linspace(1.0, 0.3, 3000)
    rows = np.column_stack((time, voltage, 1e-6 * voltage + 1e-7 * np.roll(voltage, 20)))
    head = "time,voltage,deflection"
    np.savetxt(folder / "a.csv", rows, delimiter=",", header=head, comments="")
    monkeypatch.setattr(sys, "argv", ["identify", "hysteresis", "a.csv"])
    assert identification.main(["hysteresis", str(folder / "a.csv"), "--out", str(folder)]) == 0
    return folder / "hysteresis.html"


def of_synthesize(folder, monkeypatch):
    problem = design.read_problem(params_folder() / "synthesis_robust.yaml")
    controller = read_controller("robust")
    certificate = certify(problem, controller, 1.0)
    *_, page = design.write_report(folder, problem, controller, certificate, "from a test")
    return page


@needs_bokeh
@pytest.mark.parametrize("made", [a_report, of_servo, of_identify, of_synthesize])
def test_a_report_draws_its_curves_without_a_network(tmp_path, browser, monkeypatch, made):
    report = made(tmp_path, monkeypatch)
    context = browser.new_context(offline=True)
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    fetched = []
    page.on("request", lambda request: fetched.append(request.url.split(":")[0]))
    page.goto(report.as_uri())
    pictures_shown = page.locator("figure img").count()
    for index in range(pictures_shown):
        page.get_by_text("zoom, and read values").nth(index).click()
    page.wait_for_function(f"Bokeh.documents.length == {pictures_shown}")
    page.wait_for_function("!document.querySelector('details.zoom > div:empty')")
    assert errors == [] and set(fetched) <= {"file", "data"}
    context.close()
