"""Runs a named experiment on real ROS 2 nodes: starts them, records, analyses, reports."""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from piezo_control.parameters import ParameterError
from piezo_control.recording import BagError
from piezo_sim.experiment import step
from piezo_sim.experiment.cases import params_folder, read_experiment
from piezo_sim.experiment.conductor import RunFailed
from piezo_sim.experiment.processes import NodeDied
from piezo_sim.experiment.report import print_table
from piezo_sim.experiment.runner import Interrupted, run_cases

EXPERIMENTS = {"step": step.conclude}


def main() -> int:
    """Run the command line and return its exit code: 0 done, 1 failed, 2 unusable input."""
    arguments = parse()
    console = Console()
    out = arguments.out or Path("out") / arguments.name
    try:
        title, cases = read_experiment(
            params_folder() / "experiments" / f"{arguments.name}.yaml", overrides(arguments)
        )
        prepare(out, arguments.overwrite)
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        )  # fmt: skip
        with Progress(*columns, console=console) as progress:
            runs = list(run_cases(cases, out, arguments.namespace, progress))
        for section in EXPERIMENTS[arguments.name](runs, out, title):
            print_table(console, section)
    except (ParameterError, FileExistsError) as error:
        print(f"experiment: {error}", file=sys.stderr)
        return 2
    except (NodeDied, RunFailed, Interrupted, BagError) as error:
        print(f"experiment: {error}", file=sys.stderr)
        return 1
    console.print(f"report: {out / 'report.html'}")
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="experiment", description=__doc__)
    parser.add_argument("name", choices=EXPERIMENTS, help="which experiment")
    parser.add_argument("--out", type=Path, help="folder for the results (default: out/NAME)")
    parser.add_argument("--overwrite", action="store_true", help="replace earlier results in --out")
    parser.add_argument("--namespace", default="finger", help="namespace of the nodes")
    parser.add_argument("--controller", help="controller of the feedback cases, as in params/")
    parser.add_argument(
        "--plant", choices=("prandtl_ishlinskii", "truth"), help="class of the plant"
    )
    return parser.parse_args()


def overrides(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the experiment keys given on the command line."""
    given = {"controller": arguments.controller, "plant": arguments.plant}
    return {key: value for key, value in given.items() if value}


def prepare(out: Path, overwrite: bool) -> None:
    """Make the folder `out`; raise FileExistsError if it has results that may not be replaced."""
    if out.exists() and any(out.iterdir()):
        if not overwrite:
            raise FileExistsError(f"{out} is not empty; name a new --out or give --overwrite")
        for old in ("bags", "log"):
            shutil.rmtree(out / old, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
