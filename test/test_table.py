# SPDX-License-Identifier: Apache-2.0
"""Tables as instruments write them: one known measurement, read from every shape it may have."""

import io
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piezo_control.identification.measurement import MeasurementError, read_measurement
from piezo_control.identification.table import read_table
from piezo_control.identification.units import split_name

FORMATS = Path(__file__).parent / "data" / "formats"
VOLTAGE = np.round(20.0 * np.sin(2.0 * np.pi * np.arange(60) / 40.0), 3)
COLUMNS = {
    "spreadsheet_de.csv": {"time": "Zeit", "voltage": "Spannung", "deflection": "Auslenkung"},
    "empty_first_column.csv": {"time": "1", "voltage": "2", "deflection": "3:um"},
    "blanks.dat": {"time": "0", "voltage": "1", "deflection": "2:um"},
    "labview.lvm": {"time": "X_Value"},
    "oscilloscope_head.csv": {"voltage": "CH1", "deflection": "CH2:um"},
    "oscilloscope_units.csv": {"voltage": "A", "deflection": "B"},
    "oscilloscope_increment.csv": {"time": "X", "voltage": "CH1", "deflection": "CH2:um"},
    "polytec.txt": {"deflection": "Displacement"},
    "attocube.csv": {"voltage": "U", "deflection": "Axis 1"},
    "oscilloscope_numbers.csv": {"time": "x-axis", "voltage": "1", "deflection": "2:um"},
}


@pytest.mark.parametrize("path", sorted(FORMATS.iterdir()), ids=lambda path: path.name)
def test_every_format_gives_the_same_measurement(path):
    """A finger of 0.5 µm/V under 20 V, 60 rows 10 ms apart, in the shapes of test/data/formats."""
    found = read_measurement(path, COLUMNS.get(path.name, {}))
    np.testing.assert_allclose(found.time, 0.01 * np.arange(60), atol=1e-9)
    np.testing.assert_allclose(found.voltage, VOLTAGE, atol=1e-9)
    np.testing.assert_allclose(found.deflection, 0.5e-6 * VOLTAGE, atol=1e-10)
    assert "read 60 rows" in found.description and "voltage = column" in found.description


QUANTITIES = {"time": ("s", "ms"), "voltage": ("V", "mV"), "deflection": ("um", "nm", "mm")}
SCALES = {"s": 1.0, "ms": 1e-3, "V": 1.0, "mV": 1e-3, "um": 1e-6, "nm": 1e-9, "mm": 1e-3}
ABOVE = {
    "nothing": [], "comments": ["# a comment, with a comma; and more", "% another"], "sep": ["sep={}"],
    "title": ["Finger2"], "instrument": ["Model{0}MSO44", "Sample Interval{0}0.005", "Points{0}55{0}", ""],
}  # fmt: skip


@st.composite
def shapes(draw):
    """A measurement in one of the shapes that it may be written in."""
    separator = draw(st.sampled_from([",", ";", "\t", "|", " "]))
    quoted = draw(st.booleans())
    order = draw(st.permutations([*QUANTITIES, *draw(st.sampled_from([[], ["setpoint"]]))]))
    names = draw(st.sampled_from(["bare", "units", "row", "none", "comment"]))
    above = "nothing" if names == "none" else draw(st.sampled_from(list(ABOVE)))
    if separator == " " and above in ("instrument", "title"):
        above = "comments"  # its words would be as many columns
    return {
        "separator": separator,
        "quoted": quoted,
        "comma": draw(st.booleans()) and (separator != "," or quoted),
        "order": order,
        "units": {q: draw(st.sampled_from(units)) for q, units in QUANTITIES.items()},
        "names": names,
        "above": above if names != "comment" or above == "comments" else "nothing",
        "encoding": draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"])),
        "newline": draw(st.sampled_from(["\n", "\r\n", "\r"])),
        "minus": draw(st.sampled_from(["-", "−"])),
        "end": draw(st.sampled_from(["", "\n", "\n\n"])),
        "seed": draw(st.integers(0, 10)),
    }


def write(path, shape):
    """Write 55 rows of a random measurement; return its quantities (SI) and what names their columns."""
    random = np.random.default_rng(shape["seed"])
    units = shape["units"]
    table = {"time": 0.02 * np.arange(55), "voltage": random.normal(0, 20, 55),
             "deflection": random.normal(0, 9e-6, 55), "setpoint": random.normal(0, 5, 55)}  # fmt: skip
    texts = {
        q: [f"{value / SCALES[units[q]] if q in units else value:.7f}" for value in values]
        for q, values in table.items()
    }
    exact = {q: SCALES[units[q]] * np.array(texts[q], float) for q in units}
    order, separator = shape["order"], shape["separator"]
    mark = '"' if shape["quoted"] else ""
    headings = {
        "units": [f"{q.title()}({units[q]})" if q in units else q for q in order],
        "none": [],
    }.get(shape["names"], order)
    lines = [line.format(separator) for line in ABOVE[shape["above"]]]
    if headings:
        sign = "# " if shape["names"] == "comment" else ""
        lines.append(sign + separator.join(f"{mark}{heading}{mark}" for heading in headings))
    if shape["names"] == "row":
        lines.append(separator.join(units.get(q, "V").replace("u", "µ") for q in order))
    for cells in zip(*(texts[q] for q in order)):
        cells = [cell.replace("-", shape["minus"]) for cell in cells]
        if shape["comma"]:
            cells = [cell.replace(".", ",") for cell in cells]
        lines.append(separator.join(f"{mark}{cell}{mark}" for cell in cells))
    text = shape["newline"].join(lines) + shape["end"]
    if shape["encoding"] == "cp1252":  # has no minus but the hyphen
        text = text.replace("−", "-")
    path.write_bytes(text.encode(shape["encoding"]))
    if shape["names"] in ("units", "row"):
        return exact, {}
    named = shape["names"] != "none"
    return exact, {q: f"{q if named else order.index(q)}:{units[q]}" for q in units}


@settings(max_examples=100)
@given(shapes())
def test_a_measurement_comes_back_from_any_shape(tmp_path_factory, shape):
    path = tmp_path_factory.mktemp("table") / "measured.txt"
    exact, columns = write(path, shape)
    found = read_measurement(path, columns)
    for quantity, values in exact.items():
        np.testing.assert_allclose(getattr(found, quantity), values, rtol=1e-12, atol=1e-20)


@pytest.mark.parametrize("comment", ["\tComment", ""])
@pytest.mark.parametrize("end", ["\t", ""])
def test_labview_names_a_comment_that_no_row_has_and_units_above(tmp_path, comment, end):
    """As NI's "Specification for the LabVIEW Measurement File" has them: Y_Unit_Label, one for each channel."""
    path = tmp_path / "a.lvm"
    text = (
        (FORMATS / "labview.lvm")
        .read_text()
        .replace("Voltage\tDeflection [um]\tComment", f"CH0\tCH1{comment}")
    )
    text = text.replace("X0\t", "Y_Unit_Label\tmV\tum\t\nX0\t").replace("\t\n0.", f"{end}\n0.")
    path.write_text(text)
    found = read_measurement(path, {"time": "X_Value", "voltage": "CH0", "deflection": "CH1"})
    np.testing.assert_allclose(found.voltage, 1e-3 * VOLTAGE, atol=1e-12)
    np.testing.assert_allclose(found.deflection, 0.5e-6 * VOLTAGE, atol=1e-10)


DAMAGES = {
    "a word in a cell": lambda rows, k: rows[k].__setitem__(0, "low"),
    "a cell too many": lambda rows, k: rows[k].extend(["7.0", "8.0"]),
    "a name too few": lambda rows, k: rows[0].pop(0),
    "a name too many": lambda rows, k: rows[0].insert(0, "number"),
    "the time stands still": lambda rows, k: rows[k].__setitem__(0, rows[k - 1][0]),
    "the time goes back": lambda rows, k: rows[k].__setitem__(0, "-1.0"),
    "infinity": lambda rows, k: rows[k].__setitem__(1, "inf"),
    "many empty cells": lambda rows, k: [row.__setitem__(1, "") for row in rows[30:]],
    "names again": lambda rows, k: rows.insert(k, list(rows[0])),
    "another unit": lambda rows, k: rows[0].__setitem__(2, "deflection [V]"),
    "no voltage": lambda rows, k: [row.pop(1) for row in rows],
    "too few rows": lambda rows, k: rows.__delitem__(slice(20, None)),
}


@settings(max_examples=60)
@given(st.sampled_from(list(DAMAGES)), st.integers(2, 50), st.sampled_from(",;\t|"))
def test_a_damaged_one_is_refused(tmp_path_factory, damage, k, separator):
    rows = [["time", "voltage", "deflection_um"]]
    rows += [[f"{0.02 * n:.2f}", f"{n % 7}.5", f"{n % 5}.25"] for n in range(55)]
    DAMAGES[damage](rows, k)
    path = tmp_path_factory.mktemp("table") / "damaged.txt"
    path.write_text("\n".join(separator.join(row) for row in rows) + "\n")
    with pytest.raises(MeasurementError, match="damaged.txt: "):
        read_measurement(path)


@pytest.mark.parametrize(
    "header, expected",
    [
        ("Voltage (V)", ("Voltage", "V")), ("x [µm]", ("x", "um")), ("disp_nm", ("disp", "nm")),
        ("U / V", ("U", "V")), ("Temp [C]", ("Temp", "degc")), ("V+ [V]", ("V+", "V")),
        ("U (Volts)", ("U", "V")), ("t [seconds]", ("t", "s")), ("plain", ("plain", "")), ("run_2", ("run_2", "")),
        ("Time (msec)", ("Time", "ms")), ("Time_usec", ("Time", "us")), ("t [µsec]", ("t", "us")),
        ("voltage (mv)", ("voltage", "mV")), ("U [kv]", ("U", "kV")), ("time in ms", ("time", "ms")),
        ("Temp C", ("Temp C", "")), ("Torque [Nm]", ("Torque [Nm]", "")), ("V_in", ("V_in", "")),
    ],
)  # fmt: skip
def test_names_give_their_units(header, expected):
    assert split_name(header) == expected


HEADINGS = ("time (s)", "voltage (V)", "deflection (um)")


def write_table(path, headings=HEADINGS, time=lambda k: f"{0.1 * k:.1f}", rows=60):
    """Write 60 rows 0.1 s apart, voltages of up to 6 V, deflections of 2 µm each further than the one before."""
    lines = [",".join(headings), *(f"{time(k)},{k % 7},{2 * k}" for k in range(rows))]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("place", "heading", "unit"),
    [
        (0, "time (jiffies)", "jiffies"), (0, "time_ns", "ns"), (0, "time [MS]", "MS"), (1, "voltage (counts)", "counts"),
        (1, "voltage_uV", "uV"), (2, "deflection / inch", "inch"), (2, "deflection [Nm]", "Nm"),
        (2, "deflection mils", "mils"),
    ],
)  # fmt: skip
def test_a_unit_that_is_not_understood_is_refused_until_it_is_said(tmp_path, place, heading, unit):
    headings = [*HEADINGS[:place], heading, *HEADINGS[place + 1 :]]
    path = write_table(tmp_path / "a.csv", headings)
    quantity = ("time", "voltage", "deflection")[place]
    words = f"is in {unit}, '{quantity}' must be in one of .*as in --{quantity} {place}:"
    with pytest.raises(MeasurementError, match=words):
        read_measurement(path, {quantity: str(place)})
    said = read_measurement(path, {quantity: f"{place}:{('ms', 'mV', 'nm')[place]}"})
    assert f"{quantity} = column '{heading}' [{('ms', 'mV', 'nm')[place]}]" in said.description
    below = tmp_path / "below.csv"
    units = ["s", "V", "um"]
    units[place] = unit
    write_table(below, ["time,voltage,deflection\n" + units[0], *units[1:]])
    with pytest.raises(MeasurementError, match=f"is in {unit}, '{quantity}' must be in one of"):
        read_measurement(below)


def of_clock(step, form):
    """Return times that are `step` seconds apart in a form of hours, minutes and seconds."""
    return lambda k: form.format(h=k * step // 3600, m=k * step // 60 % 60, s=k * step % 60)


@pytest.mark.parametrize(
    ("heading", "column", "form", "step", "taken"),
    [
        ("time", None, "{h}:{m:02}:{s:02}", 1, "h:min:s"),
        ("time", None, "{h}:{m:02}:{s:02}", 600, "h:min:s"),  # beyond 24 h
        ("time", None, "{m:02}:{s:02}.0", 1, "min:s"),
        ("time", None, "{m:02}:{s:02}", 30, "min:s"),  # up to minute 29, no hour
        ("time", "0:min", "{m:02}:{s:02}", 1, "min:s"),
        ("time [mm:ss]", None, "{m:02}:{s:02}", 1, "min:s"),
        ("time", "time:h", "{h:02}:{m:02}", 60, "h:min"),
        ("time (hh:mm)", None, "{h:02}:{m:02}", 60, "h:min"),
        ("time (UTC)", "0", "2024-05-01 {h:02}:{m:02}", 60, "date"),
    ],
)
def test_clocks_are_read_by_their_parts(tmp_path, heading, column, form, step, taken):
    path = write_table(tmp_path / "a.csv", (heading, *HEADINGS[1:]), of_clock(step, form))
    found = read_measurement(path, {"time": column} if column else {})
    np.testing.assert_allclose(found.time, step * np.arange(60.0))
    assert f"time = column '{heading}' [{taken}]" in found.description


def test_minutes_that_may_be_hours_are_asked_for(tmp_path):
    """600 rows 00:00 to 09:59, a second apart as a spreadsheet saves them, would be 10 minutes or 10 hours."""
    path = write_table(
        tmp_path / "a.csv", ("time", *HEADINGS[1:]), of_clock(1, "{m:02}:{s:02}"), 500
    )
    words = "minutes and seconds or hours and minutes: .*--time 0:min or --time 0:h, .*mm:ss"
    with pytest.raises(MeasurementError, match=words):
        read_measurement(path)
    assert read_measurement(path, {"time": "0:min"}).time[-1] == 499.0
    assert read_measurement(path, {}, sample_time=0.5).time[-1] == 249.5


def test_columns_by_number_and_by_a_part_of_the_name(tmp_path):
    path = tmp_path / "a.csv"
    rows = "".join(f"{0.1 * k},{k % 7},{2 * k},{3 * k}\n" for k in range(60))
    path.write_text("t [s],drive voltage [V],probe left [um],probe right [um]\n" + rows)
    columns = {"time": "0", "voltage": "drive", "deflection": "right"}
    found = read_measurement(path, columns)
    np.testing.assert_allclose(found.deflection, 3e-6 * np.arange(60))
    with pytest.raises(MeasurementError, match="'probe' for 'deflection' may be any of probe left"):
        read_measurement(path, {**columns, "deflection": "probe"})
    with pytest.raises(
        MeasurementError, match="column 't .s.' is in s, 'voltage' must be in one of"
    ):
        read_measurement(path, {**columns, "voltage": "0"})


def test_a_table_without_names_has_its_columns_in_order(tmp_path):
    """Time, voltage, deflection, nothing else; the deflection in what a finger can move."""
    path = tmp_path / "a.csv"
    for scale, unit in ((1e6, "um"), (1e3, "mm"), (1.0, "m")):
        rows = (f"{0.1 * k};{k % 7};{2e-6 * scale * k:.9f};".replace(".", ",") for k in range(60))
        path.write_text("\n".join(rows))
        found = read_measurement(path)
        np.testing.assert_allclose(found.deflection, 2e-6 * np.arange(60), atol=1e-9)
        assert f"deflection = column '2' [{unit}]" in found.description
    path.write_text("0;1;2;3\n" * 60)
    with pytest.raises(MeasurementError, match="no column for 'voltage'; the file has 0, 1, 2, 3"):
        read_measurement(path)


@pytest.mark.parametrize(("unit", "scale"), [("um", 1e6), ("nm", 1e9), ("mm", 1e3), ("m", 1.0)])
@pytest.mark.parametrize("gain", [0.44e-6, 0.054e-6, 15e-6])
def test_a_small_stroke_without_names_is_not_taken_for_a_large_one(tmp_path, gain, unit, scale):
    """2 V on the paper's finger give 0.9 µm; a PICMA stack P-882.11 6.5 µm/120 V, a bender PL128.10 15 µm/V."""
    path = tmp_path / "a.txt"
    path.write_text(
        "\n".join(f"{k / 10}\t{k % 3}\t{gain * scale * (k % 3):.9f}" for k in range(60))
    )
    found = read_measurement(path)
    assert np.ptp(found.deflection) == pytest.approx(2.0 * gain, rel=0.01)
    assert "without names: this order and these units assumed" in found.description
    assert f"deflection = column '2' [{unit}]" in found.description


@pytest.mark.parametrize(
    ("stroke", "voltage", "words"),
    [
        (60.0, 2, "spans 60 under 2 V may be in um or nm"),  # of a bender, 30 µm/V, or 30 nm/V of a stack
        (60.0, 0, "spans 60 may be in um or nm"),
        (5e3, 1e-3, "spans 5000 under 0.001 V may be in m or mm or um or nm"),  # in none that is known
    ],
)  # fmt: skip
def test_a_stroke_without_names_that_may_have_two_units_is_asked_for(
    tmp_path, stroke, voltage, words
):
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{k} {voltage * (k % 2)} {stroke * (k % 2)}\n" for k in range(60)))
    options = "--time 0 --voltage 1 --deflection 2:um"
    with pytest.raises(MeasurementError, match=f"no names, .*{words}: .* as in {options}"):
        read_measurement(path)
    columns = {"time": "0", "voltage": "1", "deflection": "2:nm"}
    assert np.ptp(read_measurement(path, columns).deflection) == pytest.approx(stroke * 1e-9)


@pytest.mark.parametrize("separator", [";", "\t", '","'])
def test_marks_between_thousands_are_not_taken_for_decimal_ones(tmp_path, separator):
    """88 µm in nm, 88,200 or 88.200; with a 0,500 or 12.50 anywhere, or decimals in each cell, they are decimals."""
    path = tmp_path / "a.csv"
    quote = separator[0] * (len(separator) > 1)

    def write(mark, first, column):
        rows = [[str(k), first, column(k).replace(",", mark)] for k in range(60)]
        text = [["time", "voltage (V)", "deflection (nm)"], *rows]
        path.write_text("".join(f"{quote}{separator.join(row)}{quote}\n" for row in text))
        return read_measurement(path)

    for mark in ",.":
        with pytest.raises(MeasurementError, match=f"'1\\{mark}470' is 1470, or has decimals"):
            write(mark, "5", lambda k: f"{1470 * k:,}")
    with pytest.raises(MeasurementError, match="'1,000' is 1000, or has decimals"):
        write(",", "5", lambda k: f"{1000 + k:,}")
    assert write(",", "0,500", lambda k: f"1,{100 + k}").deflection[-1] == pytest.approx(1.159e-9)
    assert write(".", "5", lambda k: f"1.{100 + k}").deflection[-1] == pytest.approx(1.159e-9)


@pytest.mark.parametrize("number", ["{:.4f}", "{:.3e}", "{:d}"])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_a_row_that_the_end_of_the_file_cuts_is_left_out(tmp_path, number, order):
    """Wherever the writing stopped: what is read has been written, be the last row whole, cut or left out."""
    path = tmp_path / "a.csv"
    rows = [(f"{0.1 * k:.2f}", number.format(100 + k), number.format(500 - k)) for k in range(60)]
    lines = [
        ",".join(cells[i] for i in order) for cells in [("time", "voltage", "deflection_nm"), *rows]
    ]
    text = "\n".join(lines)
    last = len(lines[-1])
    for cut in range(last + 1):
        path.write_text(text[: len(text) - cut])
        found = read_measurement(path)
        count = 60 if cut == 0 else 59
        assert len(found.time) == count
        np.testing.assert_allclose(found.voltage, 100.0 + np.arange(count))
        np.testing.assert_allclose(found.deflection, 1e-9 * (500.0 - np.arange(count)))
        said = "row 61 left out, where the file ends within a row"
        assert (said in found.description) == (0 < cut < last)


def test_few_empty_cells_are_left_out_and_counted(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{0.1 * k:.1f},{k % 7},{2 * k}" for k in range(200)]
    rows[50] = "5.0,,100"
    path.write_text("time,voltage,deflection_um\n" + "\n".join(rows) + "\n\n")
    found = read_measurement(path)
    assert len(found.time) == 199 and "1 rows with empty cells left out" in found.description


@pytest.mark.parametrize(
    "word",
    [
        "NaN",
        "nan",
        "-nan",
        "#N/A",
        "N/A",
        "#NV",
        "#DIV/0!",
        "-",
        "--",
        "1.#QNAN",
        "-1.#IND00",
        "null",
    ],
)
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_word_for_no_number_is_as_good_as_an_empty_cell(tmp_path, word, place):
    """As C, NumPy, Excel in English and German, and instruments write it; in each column, in the first row and the last."""
    path = tmp_path / "a.csv"
    table = [[f"{0.1 * k:.1f}", f"{k % 7}", f"{2 * k}"] for k in range(400)]
    rows = [0, 150, 399]
    for row in rows:
        table[row][place] = word
    for names in (["time", "voltage", "deflection_um"], []):
        path.write_text("".join(",".join(row) + "\n" for row in ([names] if names else []) + table))
        columns = {} if names else {"time": "0", "voltage": "1", "deflection": "2:um"}
        found = read_measurement(path, columns)
        kept = np.delete(np.arange(400), rows)
        np.testing.assert_allclose(found.time, 0.1 * kept)
        np.testing.assert_allclose(found.deflection, 2e-6 * kept)
        assert "3 rows with empty cells left out" in found.description


@pytest.mark.parametrize(
    "word", ["OVERLOAD", "OL", "O.L", "OVLD", "+OVER", "-Over Range", "****", "9.9E+37", "-1E+37"]
)
def test_values_beyond_the_range_of_an_instrument_are_counted_and_many_refused(tmp_path, word):
    """As multimeters, vibrometers and oscilloscopes write them; the numbers are IEEE 488.2's and an older one's."""
    path = tmp_path / "a.csv"
    table = [[f"{0.1 * k:.1f}", f"{k % 7}", f"{2 * k}"] for k in range(400)]
    for row in (100, 101, 399):
        table[row][2] = word
    table[7][1] = "--"
    for bad in (range(0), range(200, 210)):
        for row in bad:
            table[row][2] = word
        path.write_text("time,voltage,deflection_um\n" + "".join(",".join(r) + "\n" for r in table))
        if not bad:
            found = read_measurement(path)
            said = (
                "4 rows with empty cells left out, in 3 of which an instrument was out of its range"
            )
            assert len(found.time) == 396 and said in found.description
    with pytest.raises(MeasurementError, match="in 13 of them an instrument was out of its range"):
        read_measurement(path)


@pytest.mark.parametrize("unit, degc", [("K", 22.0), ("kelvin", 22.0), ("°F", 22.0), ("C", 295.15)])
def test_temperatures_are_read_in_kelvin_and_fahrenheit(tmp_path, unit, degc):
    """22 °C are 295.15 K and 71.6 °F."""
    value = 71.6 if unit == "°F" else 295.15
    path = tmp_path / "a.csv"
    rows = [f"{0.1 * k:.1f},{k % 7},{2 * k},{value}\n" for k in range(60)]
    path.write_text(f"time,voltage,deflection_um,temperature [{unit}]\n" + "".join(rows))
    np.testing.assert_allclose(read_measurement(path).temperature, degc)
    path.write_text(path.read_text().replace(f" [{unit}]", ""))
    np.testing.assert_allclose(
        read_measurement(path, {"temperature": f"3:{unit}"}).temperature, degc
    )


def test_temperatures_that_may_be_kelvin_are_asked_for_and_impossible_ones_refused(tmp_path):
    path = tmp_path / "a.csv"

    def write(heading, degc):
        rows = [f"{0.1 * k:.1f},{k % 7},{2 * k},{degc}\n" for k in range(60)]
        path.write_text(f"time,voltage,deflection_um,{heading}\n" + "".join(rows))

    write("temperature", 295.15)
    with pytest.raises(MeasurementError, match="around 295.1.* may be kelvin: .*--temperature 3:K"):
        read_measurement(path)
    write("temperature K", 22.0)  # of a thermocouple of type K
    with pytest.raises(MeasurementError, match=r"is -251.15, must be within .* °C; read in kelvin"):
        read_measurement(path)
    assert read_measurement(path, {"temperature": "3:degC"}).temperature[0] == 22.0


def test_a_clock_in_milliseconds_since_1970_is_not_taken_for_seconds(tmp_path):
    path = write_table(tmp_path / "a.csv", time=lambda k: f"{1795687200000 + 100 * k}")
    assert read_measurement(path, {"time": "0:ms"}).sample_time == pytest.approx(0.1)
    path = write_table(path, ["time", *HEADINGS[1:]], lambda k: f"{1795687200000 + 100 * k}")
    with pytest.raises(MeasurementError, match="may be ms, us or ns since 1970: .*--time 0:ms"):
        read_measurement(path)


def test_what_is_below_the_data_is_left_out_and_said(tmp_path):
    """Words in any other row stay an error."""
    path = write_table(tmp_path / "a.csv")
    data = path.read_text()
    path.write_text(data + "\nStatistics\nMean,3,59\nStd. Dev.:,2,34\nEnd of the measurement\n")
    found = read_measurement(path)
    assert (
        len(found.time) == 60 and "4 rows of words or of a summary at the end" in found.description
    )
    words = [
        "words,time,voltage,deflection_um\n",
        *(f"max,{0.1 * k:.1f},{k % 7},{k}\n" for k in range(60)),
    ]
    path.write_text("".join(words))
    assert len(read_measurement(path).time) == 60
    path.write_text(data + "Mean,3,59\n6.0,1,2\n")
    with pytest.raises(MeasurementError, match="row 62 is 'Mean', must be a finite number"):
        read_measurement(path)


def test_a_row_of_words_for_no_number_has_no_names(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("nan,nan,nan\n" + "".join(f"{k},{k % 7},{2 * k}\n" for k in range(200)))
    found = read_measurement(path, {"time": "0", "voltage": "1", "deflection": "2:um"})
    assert len(found.time) == 200


@given(st.binary(max_size=400))
def test_rubbish_is_refused_in_words(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("rubbish") / "a.csv"
    path.write_bytes(data)
    with pytest.raises(MeasurementError, match="a.csv"):
        read_measurement(path)


def test_matlab_files_of_version_7_3_are_refused_with_advice(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124, b" ") + b"\x00\x02IM" + bytes(600))
    with pytest.raises(MeasurementError, match="save it with '-v7'"):
        read_measurement(path)
    buffer = io.BytesIO()
    np.savez(buffer, text=np.array(["a"]))
    (tmp_path / "a.npz").write_bytes(buffer.getvalue())
    with pytest.raises(MeasurementError, match="no vectors of numbers; it has text"):
        read_measurement(tmp_path / "a.npz")
    assert math.isclose(read_table(FORMATS / "vectors.npz").numbers(1)[10], 20.0)
