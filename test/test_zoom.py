# SPDX-License-Identifier: Apache-2.0
"""The curves of a report's pictures, for a browser: what they keep of long ones, and that a page draws them offline."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezo_sim.experiment import zoom
from piezo_sim.experiment.report import Section, write_html

needs_bokeh = pytest.mark.skipif(not zoom.HAS_BOKEH, reason="Bokeh is not installed")


@given(st.integers(1, 30_000), st.integers(0, 2**32 - 1))
def test_no_peak_of_a_long_curve_is_lost(size, seed):
    y = np.random.default_rng(seed).normal(size=size)
    shown = zoom.thinned(y)
    assert len(shown) <= zoom.POINTS + 2
    assert (np.diff(shown) > 0).all() and shown[0] == 0 and shown[-1] == size - 1
    assert (y[shown].min(), y[shown].max()) == (y.min(), y.max())
    if size <= zoom.POINTS:
        assert len(shown) == size


def drawn(path):
    """A picture with a line of each kind: a curve, two straight ones, a slope; on a logarithmic axis beside it."""
    from piezo_sim.experiment import plots

    figure, (left, right) = plots.plt.subplots(1, 2)
    left.plot([0.0, 1.0, 2.0], [1.0, -2.0, 5.0], label="tip")
    left.axhline(3.0)
    left.axvline(0.5)
    left.axline((1.0, 2.0), slope=0.5)
    left.set_title("loop")
    right.semilogx([1.0, 10.0, 100.0], [0.0, -3.0, -20.0], label="gain")
    return plots.save(figure, path)


@needs_bokeh
def test_what_a_picture_shows_is_what_a_browser_gets(tmp_path):
    plot = json.loads(zoom.plot_file(drawn(tmp_path / "a.png")).read_text())
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


@needs_bokeh
def test_a_report_draws_its_curves_without_a_network(tmp_path, browser):
    picture = drawn(tmp_path / "a.png")
    write_html(tmp_path / "report.html", "A report", [Section("One", figures=[(picture, "both")])])
    context = browser.new_context(offline=True)
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    fetched = []
    page.on("request", lambda request: fetched.append(request.url.split(":")[0]))
    page.goto((tmp_path / "report.html").as_uri())
    page.locator("details.zoom summary").click()
    page.wait_for_function("Bokeh.documents.length == 1")
    page.get_by_text("zoom, and read values").wait_for()
    page.wait_for_function("document.querySelector('details.zoom div').childElementCount > 0")
    assert errors == [] and set(fetched) <= {"file", "data"}
    context.close()
