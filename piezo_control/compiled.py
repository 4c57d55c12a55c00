# SPDX-License-Identifier: Apache-2.0
"""Machine code of a loop and of every step function that it calls, by numba, kept for the next process."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import inspect
import os
import stat
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


@functools.cache
def has_numba() -> bool:
    """Say whether the compiler is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


@functools.cache
def compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function `loop` compiled, without reference counts and free of the interpreter's lock.

    What it calls is found by following names, and is compiled along. numba notices a change of the file of
    `loop`, not of what it calls, so the code is kept in a folder named after all of these sources. It is a
    folder of the user's own that nobody else may write to: what lies there is executed.
    """
    import numba
    from numba.extending import register_jitable

    kernels: list[Callable[..., Any]] = []
    _collect(loop, kernels)
    for kernel in kernels:
        register_jitable(forceinline=True)(kernel)
    sources = hashlib.sha256()
    for path in sorted({inspect.getfile(kernel) for kernel in (loop, *kernels)}):
        sources.update(Path(path).read_bytes())
    options = {"nogil": True, "error_model": "numpy", "_nrt": False}
    try:
        folder = _own_folder(sources.hexdigest()[:16])
    except OSError as error:
        warnings.warn(f"compiled anew in every process: {error}", stacklevel=2)
        return numba.njit(**options)(loop)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return numba.njit(cache=True, **options)(loop)
    finally:
        numba.config.CACHE_DIR = before


def as_arrays(tree: Any) -> Any:
    """Return nested named tuples with every list turned into a float64 array, for a compiled loop."""
    if isinstance(tree, tuple):
        return type(tree)(*map(as_arrays, tree))
    return np.array(tree, dtype=float) if isinstance(tree, list) else tree


def _collect(function: Any, kernels: list[Callable[..., Any]]) -> None:
    """Add the Python functions that `function` names, directly or as attributes of a module."""
    for name in function.__code__.co_names:
        named = function.__globals__.get(name)
        candidates = [named]
        if inspect.ismodule(named):
            candidates = [
                getattr(named, attribute, None) for attribute in function.__code__.co_names
            ]
        for candidate in candidates:
            if inspect.isfunction(candidate) and candidate not in kernels:
                kernels.append(candidate)
                _collect(candidate, kernels)


def _own_folder(name: str) -> Path:
    """Make the folder `name` in the user's cache; raise OSError unless it is the user's alone to write."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "piezo_gripper")
    folder = base / name
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for path in (base, folder):
        status = path.stat()
        if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(f"{path} is not this user's own, or others may write to it")
    return folder
