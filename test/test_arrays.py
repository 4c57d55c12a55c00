# SPDX-License-Identifier: Apache-2.0
"""Files of other programs, written by the libraries that are kept for them, give one known measurement."""

import sys

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from piezo_control.identification.measurement import MeasurementError, read_measurement

TIME = 0.01 * np.arange(80)
VOLTAGE = 20.0 * np.sin(2.0 * np.pi * TIME / 0.4)
DEFLECTION_UM = 0.5 * VOLTAGE
SIGNALS = {"time": TIME, "voltage": VOLTAGE, "deflection_um": DEFLECTION_UM}


def matlab(path):
    savemat(path, {**SIGNALS, "rate": 100.0, "remark": "finger 2"})
    return {}


def matlab_structure(path):
    savemat(path, {"run": {"t": TIME, "u": {"voltage": VOLTAGE}, "probe": DEFLECTION_UM}})
    return {"time": "run.t", "deflection": "probe:um"}


def matlab_matrix(path):
    savemat(path, {"data": np.column_stack((TIME, DEFLECTION_UM, VOLTAGE))})
    return {"time": "data[0]", "voltage": "2", "deflection": "1:um"}


def matlab_7_3(path):
    """As MATLAB writes them: HDF5 behind 512 bytes of text, row for column."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in SIGNALS.items():
            file[name] = values[None, :]
        file["#refs#/a"] = np.arange(1000.0)
        file["run/matrix"] = np.stack((TIME, VOLTAGE))
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return {"deflection": "deflection_um", "time": "time", "voltage": "voltage"}


def hdf5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        group = file.create_group("finger/signals")
        for name, values, unit in (
            ("time", TIME * 1e3, "ms"),
            ("voltage", VOLTAGE, b"V"),
            ("deflection", DEFLECTION_UM, "µm"),
        ):
            group[name] = values
            group[name].attrs["units"] = unit
        file["rate"] = 100.0
    return {}  # fmt: skip


def hdf5_record(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["run"] = np.rec.fromarrays(list(SIGNALS.values()), names=list(SIGNALS))
    return {}


def labview(path):
    """A waveform of LabVIEW: its time is a property of the channels."""
    nptdms = pytest.importorskip("nptdms")
    waveform = {"wf_increment": 0.01, "wf_start_offset": 0.0, "wf_samples": 80}
    channels = [
        nptdms.ChannelObject("Run 1", name, values, {**waveform, "unit_string": unit})
        for name, values, unit in (("Voltage", VOLTAGE, "V"), ("Probe", DEFLECTION_UM, "um"))
    ]
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)
    return {"deflection": "Probe"}


def labview_without_waveforms(path):
    nptdms = pytest.importorskip("nptdms")
    start = np.datetime64("2024-05-01T12:00:00")
    stamps = start + np.round(TIME * 1e6).astype("timedelta64[us]")
    columns = {"Time": stamps, "Voltage": VOLTAGE, "Deflection [um]": DEFLECTION_UM}
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("Run", n, v) for n, v in columns.items()])
    return {}


def parquet(path):
    pytest.importorskip("fastparquet")
    pd.DataFrame(SIGNALS).to_parquet(path)
    return {}


def parquet_with_instants(path):
    pytest.importorskip("fastparquet")
    frame = pd.DataFrame(SIGNALS)
    frame["time"] = pd.Timestamp("2024-05-01") + pd.to_timedelta(TIME, unit="s")
    frame.to_parquet(path)
    return {}


def matlab_with_longer_and_shorter_vectors(path):
    savemat(
        path, {"preview": np.zeros(500), **SIGNALS, "zero": np.zeros(500), "gains": np.arange(9.0)}
    )
    return {}


def matlab_with_a_longer_run_of_something_else(path):
    """The voltage of the one that has a deflection is meant, also where it is only a part of a name."""
    savemat(path, {"warm": {"time": np.arange(500.0), "voltage": np.zeros(500)}, "loop": SIGNALS})
    return {"deflection": "deflection_um", "time": "loop.time"}


def labview_with_notes_before_waveforms(path):
    nptdms = pytest.importorskip("nptdms")
    waveform = {"wf_increment": 0.01, "wf_start_offset": 0.0}
    channels = [
        nptdms.ChannelObject("Run", "Note", np.arange(3.0)),
        nptdms.ChannelObject("Run", "Event", np.arange(5.0), {**waveform, "wf_increment": 1.0}),
        nptdms.ChannelObject("Run", "Mark", np.arange(80.0)),
        nptdms.ChannelObject("Run", "Voltage", VOLTAGE, {**waveform, "unit_string": "V"}),
        nptdms.ChannelObject("Run", "Deflection", DEFLECTION_UM, {**waveform, "unit_string": "um"}),
    ]
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)
    return {}


def hdf5_with_units_in_arrays(path):
    """h5py, and MATLAB's h5writeatt, write a list of one unit as an array."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values, unit in (
            ("time", 1e3 * TIME, "ms"),
            ("voltage", VOLTAGE, "V"),
            ("deflection", DEFLECTION_UM, "µm"),
        ):
            file[name] = values
            file[name].attrs["units"] = [unit]
    return {}  # fmt: skip


def numpy_instants(path):
    """They become seconds, whatever their name says."""
    stamps = np.datetime64("2024-05-01") + np.round(TIME * 1e6).astype("timedelta64[us]")
    with path.open("wb") as file:
        np.savez(file, time_ms=stamps, voltage=VOLTAGE, deflection_um=DEFLECTION_UM)
    return {}


def spreadsheet(path):
    pytest.importorskip("openpyxl")
    frame = pd.DataFrame({"Time [ms]": 1e3 * TIME, "Voltage (V)": VOLTAGE, "x": DEFLECTION_UM})
    frame.to_excel(path, index=False)
    return {"deflection": "x:um"}


def spreadsheet_with_units_below(path):
    pytest.importorskip("openpyxl")
    rows = [["time", "voltage", "deflection"], ["s", "V", "µm"]]
    rows += [[], *zip(TIME.tolist(), VOLTAGE.tolist(), DEFLECTION_UM.tolist())]
    pd.DataFrame(rows).to_excel(path, index=False, header=False)
    return {}


def numpy_matrix(path):
    np.save(path, np.column_stack(list(SIGNALS.values())))
    return {"time": "0", "voltage": "1", "deflection": "2:um"}


def numpy_record(path):
    np.save(path, np.rec.fromarrays(list(SIGNALS.values()), names=list(SIGNALS)))
    return {}


WRITERS = {
    matlab: ".mat", matlab_structure: ".mat", matlab_matrix: ".mat", matlab_7_3: ".mat", hdf5: ".h5",
    hdf5_record: ".hdf5", labview: ".tdms", labview_without_waveforms: ".tdms", parquet: ".parquet",
    parquet_with_instants: ".parquet", spreadsheet: ".xlsx", spreadsheet_with_units_below: ".xlsx",
    numpy_matrix: ".npy", numpy_record: ".npy", numpy_instants: ".npz", hdf5_with_units_in_arrays: ".h5",
    matlab_with_longer_and_shorter_vectors: ".mat", matlab_with_a_longer_run_of_something_else: ".mat",
    labview_with_notes_before_waveforms: ".tdms",
}  # fmt: skip


@pytest.mark.parametrize(("write", "end"), WRITERS.items(), ids=lambda x: getattr(x, "__name__", x))
def test_every_program_gives_the_same_measurement(tmp_path, write, end):
    path = tmp_path / f"run{end}"
    found = read_measurement(path, write(path))
    np.testing.assert_allclose(found.time, TIME, atol=1e-9)
    np.testing.assert_allclose(found.voltage, VOLTAGE, atol=1e-12)
    np.testing.assert_allclose(found.deflection, 1e-6 * DEFLECTION_UM, atol=1e-18)
    assert "read 80 rows" in found.description


@pytest.mark.parametrize(
    ("end", "library"),
    [(".h5", "h5py"), (".tdms", "nptdms"), (".parquet", "fastparquet"), (".xlsx", "openpyxl")],
)
def test_a_library_that_is_absent_is_named(tmp_path, monkeypatch, end, library):
    path = tmp_path / f"run{end}"
    path.write_bytes(b"PK")
    for name in (library, "pyarrow"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        MeasurementError, match=f"run{end}: .*reading it takes {library}: pip install {library}"
    ):
        read_measurement(path)


@pytest.mark.parametrize(("write", "end"), WRITERS.items(), ids=lambda x: getattr(x, "__name__", x))
def test_half_a_file_is_refused_in_words(tmp_path, write, end):
    path = tmp_path / f"run{end}"
    columns = write(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MeasurementError, match=f"run{end}: "):
        read_measurement(path, columns)


def test_what_a_file_has_instead_of_vectors_is_said(tmp_path):
    savemat(tmp_path / "a.mat", {"remark": "finger 2", "rate": 100.0})
    with pytest.raises(MeasurementError, match="a.mat: no vectors of numbers; it has remark, rate"):
        read_measurement(tmp_path / "a.mat")


def test_vectors_of_all_lengths_are_listed_where_none_fit(tmp_path):
    savemat(tmp_path / "a.mat", {**SIGNALS, "preview": np.zeros(500)})
    words = "no column 'x' for 'voltage'; the file has preview; not as long: time, voltage, deflection_um"
    with pytest.raises(MeasurementError, match=words):
        read_measurement(tmp_path / "a.mat", {"voltage": "x"})
    found = read_measurement(tmp_path / "a.mat")
    assert "1 of other lengths passed over: time" in found.description
