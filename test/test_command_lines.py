# SPDX-License-Identifier: Apache-2.0
"""Any words after a command: it is done, it fails or it refuses, by exit code and in words, never with a traceback.

What takes long and lies behind the reading of the command line is left out here; other tests run it.
"""

import contextlib
import errno
import functools
import importlib
import io
import itertools
import os
import re
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("numba")  # `commission` and `udp_finger` import it

from piezo_control import start
from piezo_control.design import cli as design
from piezo_control.design.problem import SynthesisError
from piezo_control.export import cli as export
from piezo_control.identification import cli as identification
from piezo_control.nodes import fingerctl
from piezo_control.parameters import ParameterError
from piezo_control.servo import commission
from piezo_sim import udp_finger
from piezo_sim.experiment import cli as experiment
from piezo_sim.experiment import monte_carlo
from piezo_sim.experiment.cases import params_folder
from piezo_sim.experiment.on_nodes import grasp
from piezo_sim.experiment.on_nodes import servo as servo_study

NUMBERS = (
    "0",
    "-1",
    "1",
    "1e-3",
    "0.5",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "5e-324",
    "9" * 400,
    "1e999",
)
WORDS = (
    "",
    " ",
    "-",
    "--",
    "robust",
    "step",
    "µm",
    "\udcff",
    "a" * 5000,
    "{x}",
    "[bold]",
    "%s",
    "/nowhere/at/all",
)


def leave_out(*_, error=SynthesisError, **__):
    raise error("left out")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of files as one may name by mistake; it is the working directory of the commands."""
    folder = tmp_path_factory.mktemp("here")
    (folder / "empty").write_bytes(b"")
    (folder / "binary").write_bytes(bytes(range(256)))
    (folder / "list.yaml").write_text("[1, 2]\n")
    (folder / "deep.yaml").write_text("[" * 400)
    (folder / "node.yaml").write_text("/**/feedback: {ros__parameters: {sample_time: text}}\n")
    (folder / "nan.csv").write_text("time,voltage,deflection\n" + "nan,nan,nan\n" * 20)
    time = np.arange(40) * 1e-3
    rows = np.column_stack([time, np.sin(50 * time), 1e-6 * np.sin(50 * time)])
    np.savetxt(
        folder / "short.csv", rows, delimiter=",", header="time,voltage,deflection", comments=""
    )
    (folder / "folder").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(experiment, "run_into", lambda *_: None)
        patch.setattr(design, "synthesize", leave_out)
        patch.setattr(monte_carlo, "run_draws", functools.partial(leave_out, error=ParameterError))
        patch.setattr(commission, "commission", leave_out)
        answers = functools.partial(leave_out, error=ParameterError)
        patch.setattr(udp_finger.UdpFinger, "start", answers)
        yield sorted(path.name for path in folder.iterdir())


def run(main, words):
    """Return exit code and words of a command, as it would be in a process of its own."""
    said = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="backslashreplace", write_through=True)
    out = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["command", *words])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
            try:
                code = main()
            except SystemExit as stopped:
                code = stopped.code or 0
    return code, said.buffer.getvalue().decode(), out.buffer.getvalue().decode()


def options(main, commands):
    """Return the options that the helps of a command and of its commands name."""
    helps = [run(main, [*command, "--help"])[2] for command in commands]
    return sorted(
        {word for text in helps for word in re.findall(r"--[a-z][a-z-]+", text)} - {"--help"}
    )


@pytest.mark.parametrize(
    "option, value, allowed",
    [
        ("--slew-limit", "nan", "[0.001, 1e+06]"),
        ("--slew-limit", "1e9", "[0.001, 1e+06]"),
        ("--voltage-high", "5000", "[-1000, 1000]"),
        ("--voltage-low", "50", "below 'voltage_high'"),
        ("--rest-voltage", "inf", "[-1000, 1000]"),
        ("--share", "10", "[0.001, 1]"),
        ("--share", "nan", "[0.001, 1]"),
        ("--sample-time", "0", "[1e-06, 0.1]"),
    ],
)
def test_what_no_finger_stands_is_refused_before_it_moves(files, option, value, allowed):
    code, said, _ = run(commission.main, [f"{option}={value}", "--yes"])
    assert code == 2
    assert allowed in said and value.removesuffix("e9") in said, said


PROBLEM = str(params_folder() / "synthesis_robust.yaml")


@pytest.mark.parametrize(
    "main, words",
    [
        (experiment.main, ["step", "--out"]),
        (experiment.main, ["analyse", "short.csv", "--out"]),
        (identification.main, ["hysteresis", "short.csv", "--out"]),
        (design.main, [PROBLEM, "--out"]),
        (design.main, [PROBLEM, "--report"]),
        (export.main, ["--out"]),
        (monte_carlo.main, ["robust", "--out"]),
        (commission.main, ["--yes", "--out"]),
        (udp_finger.main, ["--report"]),
        (servo_study.main, ["--out"]),
    ],
    ids=lambda entry: " ".join(entry).replace(PROBLEM, "") if isinstance(entry, list) else "",
)
@pytest.mark.parametrize(
    "name, reason",
    [
        ("", "is empty"),
        ("n" * 300, "File name too long"),
        ("µ" * 150, "File name too long"),
        ("empty/x", "/empty, which is no folder"),
        ("/dev/null/x", "/dev/null, which is no folder"),
        ("/dev/full", "is no fo lder or file"),
        ("a\nb", "holds a control character"),
        ("a\0b", "holds a control character"),
        ("THE OTHER KIND", "; name a "),
    ],
)
def test_where_nothing_can_be_written_is_refused_before_anything_is_done(
    files, main, words, name, reason
):
    is_file = main is udp_finger.main or (main is design.main and words[-1] == "--out")
    name = name.replace("THE OTHER KIND", "folder" if is_file else "empty")
    reason = reason.replace("fo lder or file", "file" if is_file else "folder")
    code, said, _ = run(main, [*words, name])
    assert code == 2 and reason in said.splitlines()[-1] and "Traceback" not in said
    assert sorted(os.listdir()) == files


def test_letters_that_a_terminal_does_not_have_end_nothing(monkeypatch):
    terminal = io.TextIOWrapper(io.BytesIO(), "ascii", write_through=True)
    say = types.SimpleNamespace(main=lambda: print("5 µm"))
    monkeypatch.setattr(start.signal, "signal", lambda *_: None)
    monkeypatch.setattr(importlib, "import_module", lambda name: say)
    monkeypatch.setattr(sys, "stdout", terminal)
    start.executable("a")()
    assert terminal.buffer.getvalue() == b"5 ?m\n"


def test_a_commissioning_that_nobody_answers_ends_with_a_line(files, monkeypatch):
    monkeypatch.setattr(commission, "commission", lambda bench, console, agree: agree("step?"))
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    code, said, _ = run(commission.main, ["--driver=simulated"])
    assert (code, said) == (1, "commission: nobody is there to answer; --yes asks nothing\n")


def test_a_working_directory_that_is_gone_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    code, said, _ = run(identification.main, ["hysteresis", "/nowhere.csv"])
    assert code == 2 and said.endswith("is below the working directory, which is gone\n")


def test_what_the_machine_refuses_is_said_in_a_line(monkeypatch):
    def write():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/report.html")

    monkeypatch.setattr(start.signal, "signal", lambda *_: None)
    monkeypatch.setattr(importlib, "import_module", lambda name: types.SimpleNamespace(main=write))
    said = "command: [Errno 28] No space left on device: 'out/report.html'\n"
    assert run(start.executable("a"), []) == (1, said, "")


COMMANDS = {
    "experiment": (experiment.main, [["step"], ["all"], ["analyse"], ["compare"], ["recover"], []]),
    "identify": (
        identification.main,
        [["hysteresis"], ["dynamics"], ["drift"], ["hysteresis", "short.csv"], []],
    ),
    "synthesize": (design.main, [[], [str(params_folder() / "synthesis_robust.yaml")]]),
    "monte_carlo": (monte_carlo.main, [[], ["robust"]]),
    "commission": (commission.main, [[]]),
    "udp_finger": (udp_finger.main, [[]]),
    # No finger is there, and nobody waits for one.
    "fingerctl": (
        fingerctl.main,
        [
            ["--timeout", "0.05", *words]
            for words in (
                ["set"],
                ["wave", "sine"],
                ["grip"],
                ["watch"],
                ["params", "feedback"],
                ["lifecycle"],
                ["record"],
                ["control"],
                ["state"],
                [],
            )
        ],
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_any_words_end_in_an_exit_code(name, files):
    main, commands = COMMANDS[name]
    known = options(main, commands)
    word = st.sampled_from((*NUMBERS, *WORDS, *files))
    option = st.tuples(st.sampled_from(known), word)
    numbers = itertools.count()

    @settings(max_examples=60, database=None)
    @given(st.sampled_from(commands), st.lists(word, max_size=2), st.lists(option, max_size=3))
    def words_of_any_kind(command, positional, given_options):
        given_words = [*command, *positional, *itertools.chain(*given_options)]
        if "--out" in known and "--out" not in given_words:
            given_words += ["--out", f"new{next(numbers)}"]
        code, said, _ = run(main, given_words)
        assert code in (0, 1, 2), given_words
        assert said or code == 0, given_words
        assert "Traceback" not in said

    words_of_any_kind()


@pytest.mark.parametrize("study", [servo_study, grasp])
def test_a_study_leaves_a_folder_alone_that_holds_something(study, tmp_path):
    (tmp_path / "thesis").write_text("years of work")
    code, said, _ = run(study.main, ["--out", str(tmp_path)])
    assert code == 2 and f"{tmp_path} is not empty" in said
    assert (tmp_path / "thesis").read_text() == "years of work"
