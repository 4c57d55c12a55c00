# SPDX-License-Identifier: Apache-2.0
"""Studies that stand beside the named experiments: from a command line to a folder with figures and a report."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from piezo_control.files import write_json
from piezo_control.options import output_folder
from piezo_control.parameters import ParameterError
from piezo_control.recording.recording import BagError
from piezo_control.report.page import Section, print_table, write_html
from piezo_sim.experiment.cases import RunFailed

Work = Callable[[argparse.Namespace, Path, Console], tuple[dict[str, Any], Sequence[Section]]]
"""Does a study into a folder; returns what metrics.json and the report shall hold."""


def parser(module: str, description: str) -> argparse.ArgumentParser:
    """Return the command line of a study, `python -m module`: where its results go."""
    name = module.rpartition(".")[2]
    made = argparse.ArgumentParser(
        prog=f"python -m {module}", description=description.splitlines()[0]
    )
    made.add_argument(
        "--out", type=output_folder, default=f"out/{name}", metavar="DIR", help="(%(default)s)"
    )
    made.add_argument("--overwrite", action="store_true", help="replace results in --out")
    return made


def run(arguments: argparse.Namespace, title: str, work: Work) -> int:
    """Do a study and show what it found; return the exit code: 0 done, 1 failed or stopped, 2 unusable input."""
    console = Console()
    out = arguments.out
    name = out.resolve().name
    try:
        with results_folder(out, arguments.overwrite) as folder:
            found, sections = work(arguments, folder, console)
            write_json(folder / "metrics.json", found)
            write_html(folder / "report.html", title, sections)
    except (ParameterError, FileExistsError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except (RunFailed, BagError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: stopped; what was there before in {out} is unchanged", file=sys.stderr)
        return 1
    for section in sections:
        print_table(console, section)
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
    return 0


@contextlib.contextmanager
def results_folder(out: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a new folder beside `out` for results, which are moved to `out` when all went well.

    Recordings and files replace what has the same name; everything else in `out` stays. After a
    failure the folder is left as it is and named, for its logs and for the bags of a run that was
    cut; no later run touches it. Raises FileExistsError if `out` is a file, or holds something,
    also what came meanwhile, and may not be replaced.
    """
    _need_room(out, overwrite)
    place = out.resolve()
    ends = itertools.chain([""], map("-{}".format, itertools.count(2)))
    folders = (place.parent / f"{place.name}.unfinished{end}" for end in ends)
    folder = next(folder for folder in folders if _is_made(folder))
    try:
        yield folder
        _need_room(out, overwrite)
        _put(folder, place)
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()  # which only an empty one can be
        if folder.exists():
            print(f"{place.name}: what was done until then is in {folder}", file=sys.stderr)
        raise


def _need_room(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"--out is {out}, which is a file; name a folder")
    if out.exists() and any(out.iterdir()) and not overwrite:
        raise FileExistsError(f"{out} is not empty; name a new --out or give --overwrite")


def _is_made(folder: Path) -> bool:
    """Make a folder that nobody else has; say whether that was possible."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


def _put(made: Path, place: Path) -> None:
    """Move what was made to its place; a recording is replaced whole, other folders by entry."""
    if made.is_dir() and place.is_dir() and not (made / "metadata.yaml").exists():
        for entry in made.iterdir():
            _put(entry, place / entry.name)
        made.rmdir()
        return
    if place.is_dir():
        shutil.rmtree(place)
    made.replace(place)
