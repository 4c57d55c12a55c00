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
from piezo_control.identification.table import read_table, split_name

FORMATS = Path(__file__).parent / "data" / "formats"
VOLTAGE = np.round(20.0 * np.sin(2.0 * np.pi * np.arange(60) / 40.0), 3)
COLUMNS = {
    "spreadsheet_de.csv": {"time": "Zeit", "voltage": "Spannung", "deflection": "Auslenkung"},
    "empty_first_column.csv": {"time": "1", "voltage": "2", "deflection": "3:um"},
    "blanks.dat": {"time": "0", "voltage": "1", "deflection": "2:um"},
}


@pytest.mark.parametrize("path", sorted(FORMATS.iterdir()), ids=lambda path: path.name)
def test_every_format_gives_the_same_measurement(path):
    """A finger of 0.5 µm/V under 20 V, 60 rows 10 ms apart, in the shapes of test/data/formats."""
    found = read_measurement(path, COLUMNS.get(path.name, {}))
    np.testing.assert_allclose(found.time, 0.01 * np.arange(60), atol=1e-9)
    np.testing.assert_allclose(found.voltage, VOLTAGE, atol=1e-9)
    np.testing.assert_allclose(found.deflection, 0.5e-6 * VOLTAGE, atol=1e-10)
    assert "read 60 rows" in found.description and "voltage = column" in found.description


@settings(max_examples=60, deadline=None)
@given(
    separator=st.sampled_from([",", ";", "\t", " "]),
    comma=st.booleans(),
    quoted=st.booleans(),
    names=st.sampled_from(["bare", "units", "row", "none"]),
    comment=st.sampled_from(["", "#", "%"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    newline=st.sampled_from(["\n", "\r\n"]),
    seed=st.integers(0, 10),
)
def test_a_measurement_comes_back_from_any_shape(
    tmp_path_factory, separator, comma, quoted, names, comment, encoding, newline, seed
):
    comma = comma and separator != ","
    random = np.random.default_rng(seed)
    table = np.column_stack(
        (np.arange(55) * 0.02, random.normal(0, 20, 55), random.normal(0, 9, 55))
    )
    lines = [f"{comment} a comment, with a comma; and more"] if comment else []
    quote = '"' if quoted else ""
    headings = {
        "bare": ["time", "voltage", "deflection"], "row": ["time", "voltage", "deflection"],
        "units": ["Time(s)", "Voltage[V]", "deflection_um"], "none": [],
    }[names]  # fmt: skip
    if headings:
        lines.append(separator.join(f"{quote}{heading}{quote}" for heading in headings))
    if names == "row":
        lines.append(separator.join(["s", "V", "µm"]))
    for row in table:
        cells = [f"{value:.6f}" for value in row]
        if comma:
            cells = [cell.replace(".", ",") for cell in cells]
        lines.append(separator.join(f"{quote}{cell}{quote}" for cell in cells))
    path = tmp_path_factory.mktemp("table") / "measured.txt"
    path.write_bytes((newline.join(lines) + newline).encode(encoding))
    columns = {"bare": {"deflection": "deflection:um"}, "none": {
        "time": "0", "voltage": "1", "deflection": "2:um"}}.get(names, {})  # fmt: skip
    found = read_measurement(path, columns)
    np.testing.assert_allclose(found.time, np.round(table[:, 0], 6), atol=1e-12)
    np.testing.assert_allclose(found.voltage, np.round(table[:, 1], 6), atol=1e-12)
    np.testing.assert_allclose(found.deflection, np.round(table[:, 2], 6) * 1e-6, atol=1e-16)


@pytest.mark.parametrize(
    "header, expected",
    [
        ("Voltage (V)", ("Voltage", "V")), ("x [µm]", ("x", "um")), ("disp_nm", ("disp", "nm")),
        ("U / V", ("U", "V")), ("Temp [C]", ("Temp", "degc")), ("V+ [V]", ("V+", "V")),
        ("plain", ("plain", "")), ("run_2", ("run_2", "")),
    ],
)  # fmt: skip
def test_names_give_their_units(header, expected):
    assert split_name(header) == expected


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


def test_few_empty_cells_are_left_out_and_counted(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{0.1 * k:.1f},{k % 7},{2 * k}" for k in range(200)]
    rows[50] = "5.0,,100"
    path.write_text("time,voltage,deflection_um\n" + "\n".join(rows) + "\n\n")
    found = read_measurement(path)
    assert len(found.time) == 199 and "1 rows with empty cells left out" in found.description


@given(st.binary(max_size=400))
@settings(deadline=None)
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
