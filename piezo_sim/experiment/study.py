# SPDX-License-Identifier: Apache-2.0
"""Studies that stand beside the named experiments: from a command line to a folder with figures and a report."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from piezo_control.parameters import ParameterError
from piezo_control.recording.recording import BagError
from piezo_sim.experiment.cases import RunFailed
from piezo_sim.experiment.report import Section, print_table, write_html

Work = Callable[[argparse.Namespace, Path, Console], tuple[dict[str, Any], Sequence[Section]]]
"""Does a study into a folder; returns what metrics.json and the report shall hold."""


def parser(module: str, description: str) -> argparse.ArgumentParser:
    """Return the command line of a study, `python -m module`: where its results go."""
    name = module.rpartition(".")[2]
    made = argparse.ArgumentParser(
        prog=f"python -m {module}", description=description.splitlines()[0]
    )
    made.add_argument(
        "--out", type=Path, default=Path("out", name), metavar="DIR", help="(%(default)s)"
    )
    made.add_argument("--overwrite", action="store_true", help="replace results in --out")
    return made


def run(arguments: argparse.Namespace, title: str, work: Work) -> int:
    """Do a study and show what it found; return the exit code: 0 done, 1 failed or stopped, 2 unusable input."""
    console = Console()
    out = arguments.out
    try:
        with results_folder(out, arguments.overwrite) as folder:
            found, sections = work(arguments, folder, console)
            text = json.dumps(found, indent=2, ensure_ascii=False)
            (folder / "metrics.json").write_text(text + "\n")
            write_html(folder / "report.html", title, sections)
    except (ParameterError, FileExistsError) as error:
        print(f"{out.name}: {error}", file=sys.stderr)
        return 2
    except (RunFailed, BagError, OSError) as error:
        print(f"{out.name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{out.name}: stopped; what was there before in {out} is unchanged", file=sys.stderr)
        return 1
    for section in sections:
        print_table(console, section)
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
    return 0


@contextlib.contextmanager
def results_folder(out: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a folder beside `out` for results, which take their place in `out` when all went well.

    What is in `out` under other names stays. After a failure the folder is left as it is, for its logs and for the
    bags of a run that was cut, which no later run deletes. Raises FileExistsError if `out` is a file, or holds
    something and may not be replaced.
    """
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"--out is {out}, which is a file; name a folder")
    if out.exists() and any(out.iterdir()) and not overwrite:
        raise FileExistsError(f"{out} is not empty; name a new --out or give --overwrite")
    ends = itertools.chain([""], map("-{}".format, itertools.count(2)))
    folders = (out.with_name(f"{out.name}.unfinished{end}") for end in ends)
    folder = next(folder for folder in folders if not (folder / "bags").exists())
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    yield folder
    out.mkdir(exist_ok=True)
    for made in folder.iterdir():
        replaced = out / made.name
        if replaced.is_dir():
            shutil.rmtree(replaced)
        made.replace(replaced)
    folder.rmdir()
