# SPDX-License-Identifier: Apache-2.0
"""Runs a named experiment on real ROS 2 nodes: starts them, records, analyses, reports.

Every figure is computed from the recorded bags; `analyse` and `compare` do the same for bags from anywhere.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from piezo_control.identification.columns import LOOP, add_options, chosen_columns
from piezo_control.options import output_folder
from piezo_control.parameters import ParameterError
from piezo_control.recording.recording import BagError
from piezo_control.report.page import Section, print_table, write_html
from piezo_control.start import interrupt_at_signals
from piezo_sim.experiment.analysis import ANALYSES
from piezo_sim.experiment.cases import Case, CaseRun, RunFailed, not_covered, read_experiment
from piezo_sim.experiment.on_engine import run_on_engine
from piezo_sim.experiment.study import results_folder

EXPERIMENTS = {
    "step": "step of the reference and of the temperature (Fig. 13): `make demo`",
    "transient": "step of the voltage (Fig. 3)",
    "creep": "step of the voltage, 300 s (Fig. 4)",
    "hysteresis": "deflection over voltage at 1 Hz (Fig. 5)",
    "feedforward": "deflection over reference, inverse hysteresis alone (Fig. 9)",
    "frequency": "closed-loop magnitude, 0.1 to 1e4 rad/s (Fig. 14)",
    "thermal": "a spotlight warms the finger while it holds",
    "force": "a force on the tip while the finger holds",
    "excite": "decaying sine of the voltage, made for `identify hysteresis`",
    "identification": "recordings for all of `identify`: loops, creep, a step, a warm-up",
    "all": "all of those of the paper with two controllers, against the paper: `make paper`",
}
DONE, FAILED, UNUSABLE = 0, 1, 2
WIDTH_OF_LOGS = 160


def main() -> int:
    """Run the command line and return its exit code: 0 done, 1 failed, 2 unusable input."""
    arguments = parser().parse_args()
    console = Console(width=None if sys.stdout.isatty() else WIDTH_OF_LOGS)
    out = arguments.out or Path("out") / arguments.command
    interrupt_at_signals()
    try:
        code = arguments.run_command(arguments, out, console)
    except (ParameterError, FileExistsError) as error:
        print(f"experiment: {error}", file=sys.stderr)
        return UNUSABLE
    except (RunFailed, BagError, OSError) as error:
        print(f"experiment: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("experiment: stopped", file=sys.stderr)
        return FAILED
    if (out / "report.html").exists():
        console.print(f"report: {out / 'report.html'}", soft_wrap=True)
    return code


def run_experiment(arguments: argparse.Namespace, out: Path, console: Console) -> int:
    """Run a named experiment and write metrics.json, plots and report."""
    title, cases = read_experiment(arguments.command, overrides(arguments))
    for case in cases:
        case.parameters()  # refuse what cannot run before anything does
    for text in not_covered(cases):
        print(f"experiment: not covered by the certificate: {text}", file=sys.stderr)
    with results_folder(out, arguments.overwrite) as folder:
        run_into(folder, arguments, title, cases, console)
    return DONE


def run_into(
    out: Path, arguments: argparse.Namespace, title: str, cases: Sequence[Case], console: Console
) -> None:
    """Run the cases and write what they give into the folder `out`."""
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        runs = list(run_all(cases, out, arguments.namespace, progress))
        # Imported here: matplotlib takes half a second, which the first sample need not wait for.
        from piezo_sim.experiment import paper, results

        runs.sort(key=lambda run: cases.index(run.case))
        task = progress.add_task("analysis of the bags", total=len(runs))
        found = [results.result(run) for run in progress.track(runs, task_id=task)]
        content = results.metrics(found, out)
        sections = results.sections(found, out)
        if arguments.command == "all":
            sections.insert(0, paper.section(found))
            content["paper"] = paper.compare(found)
            from piezo_sim.experiment import baselines, sensorless  # scipy, for `all` alone

            folder = out / "sensorless"
            content["sensorless"], pages = sensorless.study(folder, arguments.namespace, progress)
            known = sensorless.models_folder(folder, "truth", sensorless.CONTROLLER)
            plants = {"prandtl_ishlinskii": None, "truth": known}
            sections += [*pages, baselines.study(out / "baselines", plants, progress)]
    sections += [
        results.definitions(r.figures for r in found),
        results.origins(cases),
        results.parameters(cases),
    ]
    verdict = paper.verdict(found)
    results.write_metrics(content, out)
    footer = results.footer(content, len(found))
    write_html(out / "report.html", title, sections, verdict, footer)
    print_tables(console, sections)
    for sentence in verdict:
        console.print(escape(sentence), highlight=False)


def run_all(
    cases: Sequence[Case], out: Path, namespace: str, progress: Progress
) -> Iterator[CaseRun]:
    """Run the cases on node processes, and those meant for it on the engine."""
    on_nodes = [case for case in cases if not case.engine]
    if on_nodes:
        # Imported here: only nodes need ROS.
        from piezo_sim.experiment.on_nodes.runner import run_cases

        yield from run_cases(on_nodes, out, namespace, progress)
        interrupt_at_signals()  # again: while nodes ran, a signal was for them
    for case in cases:
        if case.engine:
            yield run_on_engine(case, out, namespace, progress)


def run_analyse(arguments: argparse.Namespace, out: Path, console: Console) -> int:
    """Analyse bags one by one; those that cannot be are named, and the others are done."""
    from piezo_sim.experiment.bags import analyse_bags

    found, code = _analyse(arguments, least=1)
    with results_folder(out, overwrite=True) as folder:
        sections = analyse_bags(found, folder)
        write_html(folder / "report.html", "Analysis of recorded bags", sections)
    print_tables(console, sections)
    return code


def run_compare(arguments: argparse.Namespace, out: Path, console: Console) -> int:
    """Compare bags in one plot and one table, without those that cannot be analysed."""
    from piezo_sim.experiment.bags import compare_bags

    found, code = _analyse(arguments, least=2)
    with results_folder(out, overwrite=True) as folder:
        sections = compare_bags(found, folder)
        write_html(folder / "report.html", "Comparison of recorded bags", sections)
    print_tables(console, sections)
    return code


def run_recover(arguments: argparse.Namespace, out: Path, console: Console) -> int:
    """Make whole bags of what can be read of cut ones; those of which nothing can be are named."""
    from piezo_control.recording.writer import recover
    from piezo_sim.experiment.bags import told_apart

    code, said = DONE, []
    with results_folder(out, overwrite=False) as folder:
        for name, path in told_apart(arguments.bags).items():
            whole = Path(name).with_suffix("") if path.is_file() else Path(name)
            try:
                said.append(f"{recover(path, folder / whole)} written to {out / whole}")
            except ValueError as error:
                # Of what is no bag, and of a second one of this name, as are x.mcap and x.db3.
                print(f"experiment: {error}", file=sys.stderr)
                code = FAILED
        if not said:
            raise BagError("nothing was recovered")
    for sentence in said:
        console.print(sentence, soft_wrap=True, markup=False)
    return code


def _analyse(arguments: argparse.Namespace, least: int) -> tuple[dict[str, Any], int]:
    """Return the recordings that could be analysed, `least` or more, and the exit code."""
    from piezo_sim.experiment.bags import analysed, told_apart

    a = arguments
    given = len(told_apart(a.bags))
    if given < least:
        raise ParameterError(f"compare needs two bags or more, not {given}")
    refused: list[BagError] = []
    columns = chosen_columns(arguments, LOOP)
    found = analysed(a.bags, a.kind, a.finger, a.run, a.partial, *columns, refused=refused)
    for name, one in found.items():
        if one.left_out:
            print(f"{name}: {one.left_out}")
    for error in refused:
        print(f"experiment: left out: {error}", file=sys.stderr)
    if len(found) < least:
        raise BagError(f"{len(found)} of {given} recordings can be analysed")
    return found, FAILED if refused else DONE


def print_tables(console: Console, sections: Sequence[Section]) -> None:
    """Print the table of each section of the results themselves."""
    for section in sections:
        if not section.is_appendix:
            print_table(console, section)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    main_parser = argparse.ArgumentParser(prog="experiment", description=__doc__)
    commands = main_parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in EXPERIMENTS.items():
        command = commands.add_parser(name, help=text, description=f"Experiment: {text}.")
        # The name once more, as argparse forgets it where "--" comes next.
        command.set_defaults(run_command=run_experiment, command=name)
        _add_experiment_options(command, name)
    for name, text, function in (
        ("analyse", "analyse bags and tables: each with plot and table", run_analyse),
        ("compare", "compare bags and tables: one plot, one table, differences", run_compare),
    ):
        command = commands.add_parser(name, help=text, description=f"{text.capitalize()}.")
        command.set_defaults(run_command=function, command=name)
        _add_bag_options(command, name, least="two or more" if name == "compare" else "one or more")
    text = "make whole bags, below --out, of what can be read of cut ones"
    command = commands.add_parser("recover", help=text, description=f"{text.capitalize()}.")
    command.set_defaults(run_command=run_recover, command="recover")
    command.add_argument("bags", type=Path, nargs="+", metavar="BAG", help="rosbag2 folders")
    command.add_argument(
        "--out", type=output_folder, help="new folder for the bags (default: out/recover)"
    )
    return main_parser


def _add_experiment_options(command: argparse.ArgumentParser, name: str) -> None:
    command.add_argument(
        "--out", type=output_folder, help=f"folder for the results (default: out/{name})"
    )
    command.add_argument("--overwrite", action="store_true", help="replace results in --out")
    command.add_argument(
        "--namespace", type=namespace, default="finger", help="namespace of the nodes"
    )
    command.add_argument(
        "--controller", nargs="+", metavar="NAME",
        help="controllers of the runs with feedback: shipped ones by name, your own by their files",
    )  # fmt: skip
    command.add_argument(
        "--plant", choices=("prandtl_ishlinskii", "truth"), help="class of the plant"
    )
    command.add_argument(
        "--temperature", dest="temperature_degc", type=float, nargs="+", metavar="DEGC",
        help="constant temperatures; where one changes, the first and the last",
    )  # fmt: skip
    command.add_argument("--amplitude-um", type=float, help="height of the reference in µm")
    command.add_argument("--amplitude-v", type=float, help="height of the voltage in V")
    command.add_argument(
        "--params", type=Path, metavar="DIR",
        help="folder whose parameter files replace the shipped ones of the same name, as of `identify`",
    )  # fmt: skip
    command.add_argument("--sample-time", type=float, help="sample time in s")
    command.add_argument("--duration", type=float, help="length of every run in s")
    command.add_argument(
        "--engine", action=argparse.BooleanOptionalAction, default=None,
        help="run all on the engine, in one process, or none (default: only what takes long)",
    )  # fmt: skip


def _add_bag_options(command: argparse.ArgumentParser, name: str, least: str) -> None:
    command.add_argument(
        "bags", type=Path, nargs="+", metavar="RECORDING",
        help=f"{least} rosbag2 folders, .mcap or .db3 files, or tables",
    )  # fmt: skip
    command.add_argument(
        "--out", type=output_folder, help=f"folder for the results (default: out/{name})"
    )
    command.add_argument(
        "--as",
        dest="kind",
        choices=ANALYSES,
        help="kind of experiment (default: what it looks like)",
    )
    command.add_argument("--finger", default="", help="namespace, when a bag holds several fingers")
    command.add_argument("--run", type=int, help="which run, from 0, when a bag holds several")
    command.add_argument(
        "--partial", action="store_true", help="use what can be read of a damaged bag"
    )
    add_options(command, LOOP)


def namespace(text: str) -> str:
    """Return a namespace that ROS 2 accepts."""
    if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"'{text}' is no namespace: letters, digits and '_'")
    return text


OVERRIDES = (
    "controller", "plant", "temperature_degc", "amplitude_um", "amplitude_v", "sample_time",
    "duration", "engine", "params",
)  # fmt: skip


def overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the experiment keys given on the command line."""
    given = {name: getattr(arguments, name) for name in OVERRIDES}
    return {name: value for name, value in given.items() if value is not None}
