# SPDX-License-Identifier: Apache-2.0
"""From parameter files to firmware: the law of the servo as one pair of C99 files.

PARAMETERS is the servo's parameter file, as `commission` writes it: it names the files of controller and
feedforward, and has the sensor's scale and what the guard looks for. Without it, the defaults: the paper's finger with
the controller 'robust'.

Written are NAME.h and NAME.c for the board, and NAME_test.c with samples of the engine: compiled together, its exit
status is 0 if NAME.c gives them. See docs/firmware.md.

Exit code: 0 written, 1 could not be written, 2 unusable input: also a controller that is not certified for this finger,
without --force.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from piezo_control.export.firmware import firmware, write
from piezo_control.feedback import FeedbackParameters, successor
from piezo_control.nodes.parameters import (
    ServoNodeParameters,
    check_delay,
    check_sensor,
    read_feedforward,
)
from piezo_control.options import output_folder
from piezo_control.parameters import ParameterError, build, load
from piezo_control.servo.law import objections


def main() -> int:
    """Run the command line and return its exit code."""
    arguments = parse()
    try:
        files = make(arguments)
    except ParameterError as error:
        print(f"export: {error}", file=sys.stderr)
        return 2
    try:
        for path in write(arguments.out, files):
            print(f"wrote {path}")
    except OSError as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    return 0


def make(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the files that are asked for; raise ParameterError when they should not be written."""
    path = arguments.parameters
    p = build(ServoNodeParameters, load(path, "servo") if path else {}, str(path or ""))
    named = {
        f"{kind}_file": value
        for kind in ("controller", "feedforward")
        if (value := getattr(arguments, kind)) is not None
    }
    p = replace(p, **named)
    if p.force_control:
        raise ParameterError(
            f"{path}: 'force_control' is true, and the law that limits a force is not exported"
        )
    controller = successor(p.controller_file, FeedbackParameters())
    feedforward = read_feedforward(p)
    check_sensor(controller, feedforward, p)
    if arguments.sample_time is not None and arguments.sample_time != controller.sample_time:
        raise ParameterError(
            f"--sample-time is {arguments.sample_time:g} s, controller '{controller.name}' was made for "
            f"{controller.sample_time:g} s"
        )
    check_delay(controller, p)
    p.check_output(feedforward)
    found = objections(controller, feedforward, feedforward.dynamics.denominator)
    if found and not arguments.force:
        raise ParameterError(
            f"controller '{controller.name}' ({p.controller_file}): {'; '.join(found)}; "
            "--force exports it all the same"
        )
    files = firmware(arguments.name, p, controller, feedforward, arguments.float)
    there = [str(arguments.out / name) for name in files if (arguments.out / name).exists()]
    if there and not arguments.overwrite:
        raise ParameterError(f"{', '.join(there)} exists; name a new --out or give --overwrite")
    for objection in found:
        print(f"export: warning: {objection}", file=sys.stderr)
    return files


def parse() -> argparse.Namespace:
    """Return the command line's arguments."""
    parser = argparse.ArgumentParser(
        prog="export", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parameters", metavar="PARAMETERS", type=Path, nargs="?", help="parameter file of the servo"
    )
    parser.add_argument(
        "--controller", help="file or shipped name, instead of the one in PARAMETERS"
    )
    parser.add_argument("--feedforward", help="file, instead of the one in PARAMETERS")
    parser.add_argument("--name", default="finger", help="prefix of files and functions (finger)")
    parser.add_argument("--out", type=output_folder, default="firmware", help="folder (firmware)")
    parser.add_argument("--float", action="store_true", help="single precision instead of double")
    parser.add_argument(
        "--sample-time",
        type=float,
        help="period of the board's timer in s: refused unless it is the controller's",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="export a controller that is not certified for this finger",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files in --out")
    return parser.parse_args()
