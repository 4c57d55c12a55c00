# SPDX-License-Identifier: Apache-2.0
"""Watches and moves running fingers and grippers from the command line; no `ros2` needed.

Without --finger it is the only finger that runs. Lengths are in µm, forces in mN, as on plots and reports; times
and frequencies are those of the finger, whose simulation may be slower or faster than the wall.

Exit code: 0 done, 1 refused, not answered or stopped by a signal, 2 unusable arguments.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import deque
from functools import partial
from typing import Any

import yaml
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from piezo_control.nodes.client import (
    TRANSITIONS,
    ClientError,
    Finger,
    Ros,
    connect,
    full_namespace,
)
from piezo_control.nodes.overview import ROWS, complaints, ended, in_order
from piezo_control.options import positive
from piezo_control.start import stop_at_signals
from piezo_control.waveform import SHAPES, Waveform

WATCH_PERIOD = 0.1  # s
DISCOVERY = 1.0  # s, in which the others become known after the first
TRACE = 40  # readings
BARS = "▁▂▃▄▅▆▇█"


def main() -> int:
    """Run the command line and return its exit code."""
    arguments = parse(sys.argv[1:])
    with connect(arguments.timeout, stop_at_signals()) as ros:
        return carry_out(ros, arguments, Console())


def carry_out(ros: Ros, arguments: argparse.Namespace, console: Console) -> int:
    """Run one command and return its exit code."""
    try:
        return arguments.run(ros, arguments, console) or 0
    except ClientError as error:
        print(f"fingerctl: {'stopped' if ros.closing.is_set() else error}", file=sys.stderr)
        return 1
    except ValueError as error:
        print(f"fingerctl: {error}", file=sys.stderr)
        return 2


def fingers(ros: Ros, arguments: argparse.Namespace) -> list[Finger]:
    """Return the fingers that were named, or the only one that is there."""
    return [ros.finger(name) for name in arguments.finger or [""]]


def has_state(finger: Finger) -> bool:
    """Say whether the finger's state is known."""
    return finger.state is not None


def is_near(finger: Finger, target: float, near: float) -> bool:
    """Say whether the finger's deflection is as near to a target (m) as `near` (m)."""
    return abs(finger.newest().deflection - target) <= near


def still(finger: Finger, target: float) -> str:
    """Return in words where a finger is that should be at a target (m)."""
    here = finger.newest().deflection
    return f"'{finger.namespace}' is at {here * 1e6:.3f} µm, not at {target * 1e6:g} µm: {finger.words()}"


def say(console: Console, text: str) -> None:
    """Print a text as it is, whatever is in it and however long its lines are."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


# --- commands -----------------------------------------------------------------------------------------


def list_all(ros: Ros, arguments: argparse.Namespace, console: Console) -> int:
    """Print the fingers that are there and their nodes."""
    ros.wait(lambda: bool(ros.fingers()), lambda: "no finger is running in this ROS domain")
    ros.closing.wait(DISCOVERY)
    for finger in (Finger(ros, name) for name in ros.fingers()):
        names = [name.rpartition("/")[2] for name in finger.nodes()]
        say(console, f"{finger.namespace}: {', '.join(names)}")
    return 0


def state(ros: Ros, arguments: argparse.Namespace, console: Console) -> int:
    """Print what every finger does; 1 if one is not in order."""
    chosen = fingers(ros, arguments)
    for finger in chosen:
        finger.wait_for(partial(has_state, finger))
    console.print(overview(chosen))
    for line in complaints(ros):
        say(console, line)
    return int(not all(in_order(finger) for finger in chosen))


def watch(ros: Ros, arguments: argparse.Namespace, console: Console) -> int:
    """Show what every finger does until Ctrl-C, or for --seconds."""
    chosen = fingers(ros, arguments)
    traces = {f.namespace: deque[float](maxlen=TRACE) for f in chosen}
    end = time.monotonic() + (arguments.seconds or math.inf)
    with Live(console=console, auto_refresh=False) as live:
        while time.monotonic() < end and not ros.closing.wait(WATCH_PERIOD):
            for finger in chosen:
                traces[finger.namespace].append(finger.newest().deflection)
            table = overview(chosen, traces)
            table.caption = "\n".join(complaints(ros)) or None
            live.update(table, refresh=True)
    return 0


def set_point(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
    """Let fingers go to a deflection, and with --wait return when they are there."""
    target = arguments.um * 1e-6
    chosen = fingers(ros, arguments)
    for finger in chosen:
        finger.set(target)
    if arguments.wait:
        near = arguments.near_um * 1e-6
        for finger in chosen:
            ros.wait(partial(is_near, finger, target, near), partial(still, finger, target))
            say(console, f"{finger.namespace}: at {finger.newest().deflection * 1e6:.2f} µm")


def wave(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
    """Let fingers follow a waveform."""
    a = arguments
    waveform = Waveform(
        shape=a.shape,
        amplitude=a.amplitude_um * 1e-6,
        frequency=a.frequency_hz,
        offset=a.offset_um * 1e-6,
        end_frequency=a.end_frequency_hz,
        duration=a.duration,
    )
    for finger in fingers(ros, arguments):
        finger.wave(waveform)


def reset(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
    """Leave latched faults and print what each node says."""
    for finger in fingers(ros, arguments):
        for name, answer in finger.reset().items():
            say(console, f"{name}: {answer}")


def record(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
    """Begin a recording, or end it."""
    for finger in fingers(ros, arguments):
        if arguments.switch == "on":
            say(console, finger.record(arguments.bag))
        else:
            finger.end_record()


def grip(ros: Ros, arguments: argparse.Namespace, console: Console) -> int:
    """Bring a gripper to an opening or a force; 1 if it came to neither."""
    a = arguments
    goal = (a.um * 1e-6, a.speed_um_s * 1e-6, a.force_mn * 1e-3)
    result = ros.gripper(a.gripper).move(*goal, timeout=a.seconds)
    console.print(ended(result))
    # Closing, a gripper that stops at the force has done what it should.
    return int(not result.reached_goal and not (result.stalled and result.force > 0.0))


def lifecycle(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
    """Print the states of all nodes, or of one after a transition."""
    if not arguments.node:
        ros.wait(lambda: bool(ros.nodes()), lambda: "no node with a lifecycle is running")
    for node in [full_name(ros, arguments)] if arguments.node else ros.nodes():
        label = ros.lifecycle(node, arguments.transition)
        say(console, f"{node}: {label}")


def params(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
    """Print parameters of a node as YAML, or set one."""
    node = full_name(ros, arguments)
    values = ros.parameters(node)
    name = arguments.name
    if name and name not in values:
        raise ClientError(f"'{node}' has no parameter '{name}'")
    if arguments.value is None:
        chosen = {name: values[name]} if name else values
        plain = {n: list(v) if hasattr(v, "tolist") else v for n, v in chosen.items()}
        say(console, yaml.safe_dump(plain, default_flow_style=None, width=math.inf).rstrip())
        return
    try:
        value = yaml.safe_load(arguments.value)
    except yaml.YAMLError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"'{name}' is '{arguments.value}', must be YAML: {text}") from None
    if isinstance(values[name], float) and type(value) is int:
        value = float(value)
    ros.set_parameters(node, {name: value})


def full_name(ros: Ros, arguments: argparse.Namespace) -> str:
    """Return the name of the node that was named: '/finger/feedback', or 'feedback' of the finger."""
    name = arguments.node
    return full_namespace(name) if name.startswith("/") else fingers(ros, arguments)[0].node(name)


# --- what is shown ------------------------------------------------------------------------------------


def overview(chosen: list[Finger], traces: dict[str, deque[float]] | None = None) -> Table:
    """Return a table with a column for every finger."""
    table = Table(box=None)
    table.add_column("")
    for finger in chosen:
        table.add_column(finger.namespace, justify="right")
    for title, cell in ROWS.items():
        table.add_row(Text(title), *(Text(cell(f, f.newest())) for f in chosen))
    if traces:
        table.add_row("deflection", *(sparkline(traces[f.namespace]) for f in chosen))
    return table


def sparkline(values: deque[float]) -> str:
    """Return values as a row of bars between the smallest and the largest."""
    known = [v for v in values if not math.isnan(v)]
    if not known:
        return "-"
    low, span = min(known), (max(known) - min(known)) or 1.0
    return "".join(BARS[int((v - low) / span * (len(BARS) - 1))] for v in known)


# --- arguments ----------------------------------------------------------------------------------------


def parse(words: list[str]) -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "-f", "--finger", action="append", metavar="NAMESPACE",
        help="of the finger; several times for several fingers",
    )  # fmt: skip
    parser.add_argument(
        "--timeout", type=positive, default=10.0, metavar="S", help="for every answer (10)"
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, run: Any, text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text[0].upper() + text[1:])
        added.set_defaults(run=run)
        return added

    def simple(name: str, text: str) -> None:
        def run(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
            for finger in fingers(ros, arguments):
                getattr(finger, name)()

        command(name, run, text)

    command("list", list_all, "the fingers that run, and their nodes")
    command("state", state, "what the fingers do; exit code 1 if one is not in order")
    watching = command("watch", watch, "a live view, until Ctrl-C")
    watching.add_argument("--seconds", type=positive, metavar="S", help="so long")
    setting = command("set", set_point, "go to a deflection and stay there")
    setting.add_argument("um", type=float, metavar="UM")
    setting.add_argument("--wait", action="store_true", help="until it is there")
    setting.add_argument(
        "--near-um", type=positive, default=0.2, metavar="UM", help="is there (0.2)"
    )
    waving = command("wave", wave, "follow a waveform")
    waving.add_argument("shape", choices=SHAPES)
    waving.add_argument("--amplitude-um", type=float, required=True, metavar="UM")
    waving.add_argument("--frequency-hz", type=positive, required=True, metavar="HZ")
    waving.add_argument("--offset-um", type=float, default=0.0, metavar="UM", help="(0)")
    waving.add_argument(
        "--end-frequency-hz", type=positive, default=0.0, metavar="HZ", help="of a sweep"
    )
    waving.add_argument(
        "--duration", type=positive, default=0.0, metavar="S",
        help="then the offset; a sweep and a decaying sine need it",
    )  # fmt: skip
    simple("zero", "go to a deflection of 0")
    simple("home", "forget what was before: a sine over the whole range that decays")
    simple("stop", "bring the voltage to rest, until 'start'")
    simple("start", "let a stopped finger run again")
    command("reset", reset, "leave latched faults")

    def control(ros: Ros, arguments: argparse.Namespace, console: Console) -> None:
        for finger in fingers(ros, arguments):
            finger.control(arguments.controller)

    command("control", control, "let another controller take over").add_argument(
        "controller", help="shipped name, file, or 'none': open loop"
    )
    recording = command("record", record, "begin or end a recording; 'recorder' has to run")
    recording.add_argument("switch", choices=("on", "off"))
    recording.add_argument(
        "bag", nargs="?", default="", help="folder, new, where the recorder runs"
    )
    gripping = command("grip", grip, "bring a gripper to an opening, or stop at a force")
    gripping.add_argument("um", type=float, metavar="UM", help="between the tips")
    gripping.add_argument(
        "--force-mn", type=positive, default=0.0, metavar="MN", help="the gripper's"
    )
    gripping.add_argument(
        "--speed-um-s", type=positive, default=0.0, metavar="UM/S", help="the gripper's"
    )
    gripping.add_argument(
        "--gripper", default="/", metavar="NAMESPACE", help="of the gripper, where it has one"
    )
    gripping.add_argument(
        "--seconds", type=positive, default=120.0, metavar="S", help="at most (120)"
    )
    states = command("lifecycle", lifecycle, "states of all nodes, or a transition of one")
    states.add_argument("node", nargs="?", default="")
    states.add_argument("transition", nargs="?", default="", choices=("", *TRANSITIONS))
    values = command("params", params, "parameters of a node as YAML, or set one")
    values.add_argument("node")
    values.add_argument("name", nargs="?", default="")
    values.add_argument("value", nargs="?", help="as YAML")
    return parser.parse_args(words)
