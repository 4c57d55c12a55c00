# SPDX-License-Identifier: Apache-2.0
"""Vectors by name out of files that are no text: MATLAB, HDF5, LabVIEW TDMS, NumPy, Parquet.

Each format is read by the library that is kept for it. Where that is not installed, the error says what to install.
A matrix gives its columns, named ``matrix[0]``, ``matrix[1]``, …; what is inside a structure, a group or a folder has
the names on the way to it, joined by dots.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

UNIT_ATTRIBUTES = ("unit", "units", "unit_string", "Unit", "Units")


class Array(NamedTuple):
    """What a file has under a name, with the unit that it says, '' for none."""

    name: str
    values: NDArray[Any]
    unit: str = ""


def read_vectors(path: Path) -> list[list[Array]]:
    """Return the vectors of numbers in a file of one of READERS, those of one length together, the longest first.

    Instants become seconds from the first. Raises ValueError with what is wrong.
    """
    try:
        arrays = list(READERS[path.suffix.lower()](path))
    except Exception as error:  # of the library that takes the bytes apart, whatever they are
        raise ValueError(f"cannot be read: {error or type(error).__name__}") from None
    of_length: dict[int, list[Array]] = {}
    for array in arrays:
        for vector in _columns(array):
            of_length.setdefault(vector.values.size, []).append(vector)
    of_length.pop(0, None)
    if not of_length:
        raise ValueError(f"no vectors of numbers; it has {', '.join(a.name for a in arrays)}")
    return [of_length[length] for length in sorted(of_length, reverse=True)]


def _columns(array: Array) -> Iterator[Array]:
    """Yield the vectors of numbers in an array: itself, the columns of a matrix, the fields of a record."""
    name, values, unit = array
    if values.dtype.names:
        for field in values.dtype.names:
            yield from _columns(Array(f"{name}.{field}" if name else field, values[field]))
        return
    values = np.squeeze(values)
    if values.dtype.kind == "M":
        values, unit = (values - values.ravel()[:1]) / np.timedelta64(1, "s"), "s"
    elif values.dtype.kind == "m":
        values, unit = values / np.timedelta64(1, "s"), "s"
    if values.dtype.kind not in "iuf" or values.ndim not in (1, 2):
        return
    if values.ndim == 1:
        yield Array(name, values.astype(float), unit)
        return
    # MATLAB's files of version 7.3 hold matrices the other way round; time is the longer side.
    matrix = values if values.shape[0] >= values.shape[1] else values.T
    for i, column in enumerate(matrix.T):
        yield Array(f"{name}[{i}]", column.astype(float), unit)


def _matlab(path: Path) -> Iterator[Array]:
    from scipy.io import loadmat

    def inside(name: str, value: Any) -> Iterator[Array]:
        if isinstance(value, dict):
            for key, entry in value.items():
                yield from inside(f"{name}.{key}", entry)
        else:
            yield Array(name, np.asarray(value))

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError:  # version 7.3, which is HDF5
        try:
            yield from _hdf5(path)
        except (OSError, ImportError) as error:
            raise ValueError(f"{error}; or save it with '-v7'") from None
        return
    for name, value in content.items():
        if not name.startswith("__"):
            yield from inside(name, value)


def _hdf5(path: Path) -> Iterator[Array]:
    h5py = _library("h5py")
    found: list[Array] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            said = [
                [*np.ravel(item.attrs[key]), ""][0] for key in UNIT_ATTRIBUTES if key in item.attrs
            ]
            unit = said[0].decode() if said and isinstance(said[0], bytes) else str(*said[:1])
            found.append(Array(name.replace("/", "."), item[()], unit))

    with h5py.File(path) as file:
        file.visititems(visit)
    yield from (array for array in found if isinstance(array.values, np.ndarray))


def _tdms(path: Path) -> Iterator[Array]:
    for group in _library("nptdms").TdmsFile.read(path).groups():
        timed: set[int] = set()  # lengths of LabVIEW's waveforms
        for channel in group.channels():
            if "wf_increment" in channel.properties and len(channel) not in timed:
                timed.add(len(channel))
                yield Array(f"{group.name}.time", channel.time_track(), "s")
            unit = str(channel.properties.get("unit_string", ""))
            yield Array(f"{group.name}.{channel.name}", np.asarray(channel[:]), unit)


def _npz(path: Path) -> Iterator[Array]:
    with np.load(path, allow_pickle=False) as arrays:
        for name, values in arrays.items():
            yield Array(name, values)


def _npy(path: Path) -> Iterator[Array]:
    yield Array("", np.load(path, allow_pickle=False))


def _parquet(path: Path) -> Iterator[Array]:
    try:
        columns = pd.read_parquet(path)
    except ImportError:
        raise absent("fastparquet") from None
    for name, column in columns.items():
        yield Array(str(name), column.to_numpy())


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise absent(name) from None


def absent(library: str) -> ImportError:
    """Return the error about a library that is not installed, to be raised."""
    return ImportError(f"reading it takes {library}: pip install {library}")


READERS: dict[str, Callable[[Path], Iterator[Array]]] = {
    ".mat": _matlab, ".h5": _hdf5, ".hdf5": _hdf5, ".tdms": _tdms, ".npz": _npz, ".npy": _npy,
    ".parquet": _parquet,
}  # fmt: skip
"""By the end of a file's name."""
