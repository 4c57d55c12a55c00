# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all: a full disk leaves what was there before."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replaced(*paths: Path) -> Iterator[list[Path]]:
    """Yield a place beside each path to write to; all take the paths' places when all went well.

    Where a path is a link, the file it leads to is replaced.
    """
    wanted = [path.resolve() for path in paths]
    written = [path.with_name(f".{os.getpid()}.{path.name}") for path in wanted]
    try:
        yield written
        for place, path in zip(written, wanted):
            place.replace(path)
    finally:
        for place in written:
            place.unlink(missing_ok=True)


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
