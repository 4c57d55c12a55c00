# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all: a full disk leaves what was there before."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replaced(*paths: Path) -> Iterator[list[Path]]:
    """Yield a place beside each path to write to; all take the paths' places when all went well.

    Where a path is a link, the file it leads to is replaced. An OSError names the paths, which that of a full disk does not.
    """
    wanted = [path.resolve() for path in paths]
    written = [path.with_name(f".{os.getpid()}.{path.name}") for path in wanted]
    try:
        yield written
        for place, path in zip(written, wanted):
            place.replace(path)
    except OSError as error:
        if error.filename is None:
            error.filename = ", ".join(map(str, paths))
        raise
    finally:
        for place in written:
            place.unlink(missing_ok=True)


def why_not(text: str, is_folder: bool) -> str:
    """Say why nothing can be written to a path, a folder or a file; empty: nothing speaks against it yet."""
    if not text:
        return "is empty"
    if any(ord(letter) < ord(" ") for letter in text):
        return "holds a control character"
    kind, other = ("folder", "file") if is_folder else ("file", "folder")
    try:
        path = Path.cwd() / text
    except FileNotFoundError:
        return "is below the working directory, which is gone"
    try:
        place = next(place for place in (path, *path.parents) if place.exists())
        if place != path and not place.is_dir():
            return f"is below {place}, which is no folder"
        if place == path and not (path.is_dir() if is_folder else path.is_file()):
            return (
                f"is a {other}; name a {kind}"
                if path.is_dir() or path.is_file()
                else f"is no {kind}"
            )
        home = place if place.is_dir() else place.parent
        if max(len(os.fsencode(part)) for part in path.parts) > os.pathconf(home, "PC_NAME_MAX"):
            return os.strerror(errno.ENAMETOOLONG)
        if not os.access(home, os.W_OK | os.X_OK):
            return f"cannot be written: {home}: {os.strerror(errno.EACCES)}"
    except OSError as error:
        return f"cannot be written: {error.strerror}"
    return ""


def write_json(path: Path, content: Any) -> Path:
    """Write plain data as JSON, which knows neither NaN nor infinity: they become null. Return the path."""
    with replaced(path) as (place,):
        place.write_text(json.dumps(_finite(content), indent=2, ensure_ascii=False) + "\n")
    return path


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
