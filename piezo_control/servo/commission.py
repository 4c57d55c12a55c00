# SPDX-License-Identifier: Apache-2.0
"""From an unknown card and finger to a directory that `servo` starts with, step by step.

1. to rest (`--rest-voltage`), from where the card is: the sensor's zero and noise;
2. a small step of the voltage: sign and gain of the sensor;
3. a small sweep: delay in samples, resonance, damping;
4. a decaying sine over the whole range: the hysteresis;
5. the design: a controller for what was found, certified.

Each step, also that to rest, asks first, and uses more voltage than the one before. The loop of the servo itself moves the finger,
with its limits of voltage and slew; a silent or saturated sensor ends at rest.

Exit code: 0 done, 1 the finger does not answer or the controller is not certified, 2 unusable input.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: small matrices only

import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.prompt import Confirm  # noqa: E402

from piezo_control.design.certificate import Certificate, certify  # noqa: E402
from piezo_control.design.cli import comment, read_problem, shortfall, show  # noqa: E402
from piezo_control.design.problem import DesignProblem, FingerModel, SynthesisError  # noqa: E402
from piezo_control.design.synthesis import synthesize  # noqa: E402
from piezo_control.feedback import FeedbackParameters  # noqa: E402
from piezo_control.feedforward import FeedforwardParameters  # noqa: E402
from piezo_control.hysteresis import deflection_history  # noqa: E402
from piezo_control.identification.dynamics import identify_dynamics  # noqa: E402
from piezo_control.identification.excitation import decaying_sine  # noqa: E402
from piezo_control.identification.fit import need, quality, straight  # noqa: E402
from piezo_control.identification.hysteresis import (  # noqa: E402
    equal_thresholds,
    identify_hysteresis,
    settled,
)
from piezo_control.identification.measurement import Measurement, MeasurementError  # noqa: E402
from piezo_control.options import output_folder, within  # noqa: E402
from piezo_control.parameters import ParameterError, build, dump, flatten  # noqa: E402
from piezo_control.profile import Profile  # noqa: E402
from piezo_control.safety import LARGEST_DEFLECTION, RAMPING, VoltageParameters  # noqa: E402
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.servo.driver import Driver, DriverError, applied, open_driver  # noqa: E402
from piezo_control.servo.law import SENSOR_OLD, SENSOR_SILENT  # noqa: E402
from piezo_control.servo.loop import Samples, Servo  # noqa: E402
from piezo_control.servo.parameters import ServoParameters  # noqa: E402
from piezo_control.shared import shared_folder  # noqa: E402
from piezo_control.start import interrupt_at_signals  # noqa: E402

VOLT = 1e-6  # m of reference per V: the loop is open here, and its command stands for a voltage
PLAYS = 16
SETTLING = 0.3  # s at rest before and after everything
PROBLEM = shared_folder() / "params" / "synthesis_robust.yaml"
SWEEP = 1.0  # s
SINE_CYCLES = 12
APPROACH = 0.5  # s from rest to the middle of the sine
# The servo's watchdogs, by the size of the finger. An object in the way takes most of the stroke.
MODEL_TOLERANCE, CYCLE_AMPLITUDE, ON_TARGET = 0.75, 0.125, 0.0125  # of the stroke
FROZEN_VOLTAGE = 0.05  # of the range of the voltage
LARGEST_NOISE = 8.0  # standard deviations of the readings that no watchdog takes for more
ATTEMPTS = 3
LATE_ATTEMPTS = 10  # where readings come late: short, and there is nothing to choose from
GOOD_MISSING_SHARE, LARGEST_MISSING_SHARE = 0.01, 0.1  # of the readings


class NoAnswer(RuntimeError):
    """A finger that does not do what one can go on with; the message says what it did."""


class LateReadings(NoAnswer):
    """Readings that were too old, or stayed away for the hold time."""


@dataclass
class Bench:
    """What moves the finger, and what is known of its sensor so far."""

    arguments: argparse.Namespace
    limits: VoltageParameters
    scale: float
    zero: float = 0.0

    @property
    def card(self) -> ServoParameters:
        """Scales of the card, as far as they are known."""
        a = self.arguments
        card = {
            "write": a.write, "sensor_scale": self.scale, "sensor_zero": self.zero,
            "amplifier_gain": a.amplifier_gain, "amplifier_zero": a.amplifier_zero,
            "card_low": a.card_low, "card_high": a.card_high,
        }  # fmt: skip
        return build(ServoParameters, card)

    def open(self) -> Driver:
        """Return the card, open."""
        a = self.arguments
        return open_driver(a.driver, a.driver_options, a.sample_time)

    def applied(self) -> float:
        """Return what the card puts out (V), of which nothing is changed; NaN: its driver does not say."""
        driver, card = self.open(), self.card
        try:
            return applied(driver, card.amplifier_gain, card.amplifier_zero)
        finally:
            driver.close()

    def move(self, voltage: Profile, duration: float) -> Samples:
        """Apply a voltage (V over s) for `duration` s and return every sample; starts and ends at rest.

        Again where readings came late, as on a machine that is busy for a moment. Raises NoAnswer when the servo ends
        it otherwise, DriverError when the device does not open.
        """
        for _ in range(LATE_ATTEMPTS - 1):
            with suppress(LateReadings):
                return self._move(voltage, duration)
        return self._move(voltage, duration)

    def _move(self, voltage: Profile, duration: float) -> Samples:
        a = self.arguments
        h = a.sample_time
        parameters = replace(
            self.card, sensor_low=-LARGEST_DEFLECTION, sensor_high=LARGEST_DEFLECTION,
            model_tolerance=LARGEST_DEFLECTION, cycle_amplitude=LARGEST_DEFLECTION,
            missed_limit=10**6, late_share=1.0,
        )  # fmt: skip
        straight = FeedforwardParameters(
            compensator="static_gain", static_gain=VOLT, **vars(self.limits)
        )
        whole = FeedbackParameters(
            sample_time=h, command_low=VOLT * self.limits.voltage_low,
            command_high=VOLT * self.limits.voltage_high,
        )  # fmt: skip
        servo = Servo(self.open(), parameters, whole, straight, a.priority)
        servo.refer(Profile([0.0], [VOLT * self.limits.rest]))
        taken = []

        def go_on() -> Samples:
            if wrong := servo.cause or servo.stuck:
                is_late = servo.cause_code in (SENSOR_OLD, SENSOR_SILENT)
                raise (LateReadings if is_late else NoAnswer)(wrong)
            time.sleep(0.02)
            servo.look_ahead()
            return servo.samples()

        try:
            servo.start()
            while servo.number < 0 or servo.phase == RAMPING:
                go_on()
            begin = servo.number * h
            moves = voltage.time + begin + SETTLING
            servo.refer(Profile(moves, VOLT * voltage.value, voltage.linear))
            while servo.number * h < begin + duration + 2.0 * SETTLING:
                taken.append(go_on())
        finally:
            if left := servo.stop():
                raise NoAnswer(left)
        return Samples(
            *(np.concatenate([getattr(s, name) for s in taken]) for name in vars(taken[0]))
        )

    def _attempts(self, voltage: Profile, duration: float) -> Iterator[Samples]:
        """Yield what came of the voltage, again while the machine did not keep time."""
        for _ in range(ATTEMPTS):
            got = self.move(voltage, duration)
            yield got
            if self._missing(got) <= GOOD_MISSING_SHARE:
                return

    @staticmethod
    def _missing(got: Samples) -> float:
        """Return the share of the samples without a reading."""
        return 1.0 - np.isfinite(got.deflection).sum() / (got.number[-1] - got.number[0] + 1)

    def measure(self, voltage: Profile, duration: float) -> Measurement:
        """Return voltage and deflection on an even grid, each deflection with the voltage held before it.

        A period that was missed held its voltage; its deflection, like one that came late, lies on the
        line between its neighbours.
        """
        got = min(self._attempts(voltage, duration), key=self._missing)
        if self._missing(got) > LARGEST_MISSING_SHARE:
            raise NoAnswer(
                f"{self._missing(got):.1%} of the readings were missed or late in the best of {ATTEMPTS} "
                f"attempts, at most {LARGEST_MISSING_SHARE:.0%} may: this machine does not keep time"
            )
        number = np.arange(got.number[0], got.number[-1] + 1)
        held = np.searchsorted(got.number, number, side="right") - 1
        there = np.isfinite(got.deflection)
        deflection = np.interp(number, got.number[there], got.deflection[there])
        return Measurement(
            "commission", self.arguments.sample_time * (number - number[0])[1:],
            got.voltage[held][:-1], deflection[1:], None, None, number[1:],
        )  # fmt: skip


@dataclass(frozen=True)
class Rest:
    """What the sensor reads at rest, m."""

    mean: float
    noise: float


def at_rest(bench: Bench) -> Rest:
    """Read the sensor at rest."""
    got = bench.move(Profile([0.0], [bench.limits.rest]), 0.2)
    there = got.deflection[np.isfinite(got.deflection)]
    if not there.size:
        raise NoAnswer("the sensor gave no reading within half a second")
    return Rest(float(there.mean()), float(there.std()))


def gain(bench: Bench, rest: Rest, voltage: float) -> float:
    """Return deflection per volt (m/V) of a small step from rest; negative if sensor or wires are reversed."""
    home = bench.limits.rest
    got = bench.move(Profile([0.0, 0.3], [home + voltage, home]), 0.6)
    there = np.isfinite(got.deflection)
    # The voltage has been a deflection on its way, of which some digits are lost.
    up = np.flatnonzero(there & (np.abs(got.voltage - (home + voltage)) < 1e-9))
    if not up.size:
        raise NoAnswer(f"no reading came while {home + voltage:.3g} V were on: sensor or card?")
    # The second half of the step: the ringing is over.
    moved = float(np.mean(got.deflection[up[up.size // 2 :]])) - rest.mean
    if abs(moved) < max(5.0 * rest.noise, 1e-12):
        raise NoAnswer(
            f"{voltage:.3g} V moved the reading by {moved * 1e6:.3g} µm, less than five times its noise "
            f"({rest.noise * 1e6:.3g} µm): sensor, amplifier or wiring?"
        )
    return moved / voltage


def sweep(amplitude: float, duration: float, sample_time: float) -> Profile:
    """Return a sine (V) whose frequency rises evenly to a third of the sampling rate."""
    t = np.arange(0.0, duration, sample_time)
    highest = 1.0 / (3.0 * sample_time)
    values = amplitude * np.sin(math.pi * highest * t**2 / duration)
    return Profile([*t, duration], [*values, 0.0])


def at_its_pace(problem: DesignProblem) -> DesignProblem:
    """Return a problem that leaves a finger slower than the paper's as many periods of its resonance as that one."""
    longer = math.sqrt(problem.finger.denominator[0] / FingerModel().denominator[0])
    times = {
        name: max(1.0, longer) * getattr(problem.specification, name)
        for name in ("settling_time", "force_settling_time")
    }
    return replace(problem, specification=replace(problem.specification, **times))


def commission(
    bench: Bench, console: Console, agree: Callable[[str], bool]
) -> tuple[Path, Certificate] | None:
    """Go through the steps; return the written directory and the certificate of its controller.

    None if somebody did not agree. `agree(question)` is asked before each step that moves the finger.
    """
    a = bench.arguments
    low, high, home = bench.limits.voltage_low, bench.limits.voltage_high, bench.limits.rest
    reach = max(home - low, high - home)
    side = 1.0 if high - home >= home - low else -1.0
    bench.card.check_output(bench.limits)
    now = bench.applied()
    says = (
        "the driver does not say what the card puts out" if math.isnan(now) else f"from {now:.3g} V"
    )
    if not agree(f"within {bench.card.span(bench.limits)}; to rest at {home:.3g} V ({says})?"):
        return None
    rest = at_rest(bench)
    bench.zero = rest.mean / bench.scale
    console.print(f"at rest: {rest.mean * 1e6:.4g} µm, noise {rest.noise * 1e9:.3g} nm rms")
    small = a.share * reach * side
    if not agree(f"step of {small:.3g} V?"):
        return None
    slope = gain(bench, Rest(0.0, rest.noise), small)
    if slope < 0.0:
        console.print("the sensor is reversed: its scale becomes negative")
        bench.scale, slope = -bench.scale, -slope
    console.print(f"gain: {slope * 1e6:.4g} µm/V, so {slope * (high - low) * 1e6:.3g} µm in all")
    amplitude = 0.5 * small
    if not agree(f"sweep of ±{abs(amplitude):.3g} V around {home + amplitude:.3g} V?"):
        return None
    wave = sweep(amplitude, SWEEP, a.sample_time)
    swept = bench.measure(Profile(wave.time, home + amplitude + wave.value), SWEEP)
    model = identify_dynamics(swept, swept.voltage)
    static = straight(swept.deflection, swept.voltage)
    fit = quality(swept.deflection, model.deflection(swept.time, swept.voltage), static)
    console.print(
        f"resonance {model.natural_frequency / (2.0 * math.pi):.1f} Hz, damping ratio "
        f"{model.damping_ratio:.4f}, delay {model.delay_samples(a.sample_time)} samples (rms {fit.rms_percent:.1f} %)"
    )
    need("one resonance and a delay", {"sweep": fit}, "a finger without vibration")
    if not agree(f"decaying sine over the whole range, {low:g} to {high:g} V?"):
        return None
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    sine = decaying_sine(half, SINE_CYCLES)
    # On the way to the middle, not at once: a lightly damped finger would ring into the loops.
    whole = Profile([0.0, *(APPROACH + sine.time)], [home, *(middle + sine.value)], sine.linear)
    slow = bench.measure(whole, APPROACH + float(sine.time[-1]))
    # A reading in ten is enough for a sine of 1 Hz.
    slow = slow.part(slice(None, None, max(1, round(1e-3 / a.sample_time))))
    hysteresis = identify_hysteresis(slow, equal_thresholds(slow, PLAYS), lag=None)
    shown = hysteresis.deflection(slow.time, slow.voltage)
    fitted = slice(settled(slow), None)
    line = straight(slow.deflection, slow.voltage, fitted=fitted)
    fit = quality(slow.deflection[fitted], shown[fitted], line[fitted])
    console.print(f"hysteresis: rms {fit.rms_percent:.2f} % of {fit.stroke * 1e6:.3g} µm")
    need("the hysteresis", {"decaying sine": fit}, "a straight line")
    # Once more, behind the hysteresis, whose width is no damping any more; now an amplifier's lag can be told from it.
    operator = partial(deflection_history, hysteresis.parameters)
    model = identify_dynamics(swept, swept.voltage, static=operator)
    delay = model.delay_samples(a.sample_time)
    lag = f"{model.bandwidth_hz:.4g} Hz" if model.bandwidth_hz else "faster than is seen"
    console.print(
        f"behind the hysteresis: damping ratio {model.damping_ratio:.4f}, delay {delay} samples, "
        f"amplifier {lag}"
    )
    # What was called zero is the finger at rest; the model's zero is a homed finger at 0 V.
    bench.zero -= float(operator([home])[0]) / bench.scale
    folder: Path = a.out
    folder.mkdir(parents=True, exist_ok=True)
    origin = f"Commissioned on driver '{a.driver}' ({a.driver_options or 'no options'})."
    limits = vars(bench.limits)
    plays = {f"hysteresis.{n}": v for n, v in flatten(hysteresis.parameters).items()}
    vibration = {"dynamics.denominator": model.denominator}
    dump(folder / "feedforward.yaml", "feedforward", {**limits, **plays, **vibration}, origin)
    finger = {
        **plays,
        "sample_time": a.sample_time,
        **vibration,
        "sensor.delay_samples": delay,
        "sensor.noise": rest.noise,
        "amplifier.bandwidth_hz": model.bandwidth_hz,
        **{f"amplifier.{name}": value for name, value in limits.items()},
    }
    dump(folder / "cantilever.yaml", "cantilever", finger, origin)
    reached = operator(slow.voltage)
    stroke, noise = float(np.ptp(reached)), LARGEST_NOISE * rest.noise
    problem = read_problem(a.problem or PROBLEM, folder / "cantilever.yaml")
    if a.problem is None:
        problem = at_its_pace(problem)
    settling = problem.specification.settling_time
    console.print(
        f"asked of the controller: into 5 % in {settling * 1e3:.3g} ms, {settling * model.natural_frequency / (2.0 * math.pi):.1f} "
        "periods of the resonance"
    )
    design = synthesize(problem)
    certificate = certify(design.problem, design.controller, design.gamma)
    show(console, certificate)
    controller = replace(design.controller, certified=certificate.met)
    dump(
        folder / "feedback.yaml",
        "feedback",
        flatten(controller),
        comment(certificate, a.problem or PROBLEM),
    )
    dump(folder / "problem.yaml", "synthesize", flatten(problem), origin)
    servo = {
        "driver": a.driver,
        "driver_options": a.driver_options,
        "write": a.write,
        "delay_samples": delay - (a.write == "next_edge"),
        "sensor_scale": bench.scale,
        "sensor_zero": bench.zero,
        "sensor_low": float(reached.min()) - 0.25 * stroke,
        "sensor_high": float(reached.max()) + 0.25 * stroke,
        "model_tolerance": MODEL_TOLERANCE * stroke,
        "cycle_amplitude": max(CYCLE_AMPLITUDE * stroke, 2.0 * noise),
        "tolerance": max(ON_TARGET * stroke, noise),
        "frozen_voltage": FROZEN_VOLTAGE * (high - low),
        "amplifier_gain": a.amplifier_gain,
        "amplifier_zero": a.amplifier_zero,
        "card_low": a.card_low,
        "card_high": a.card_high,
        "controller_file": str((folder / "feedback.yaml").resolve()),
        "feedforward_file": str((folder / "feedforward.yaml").resolve()),
    }
    dump(folder / "servo.yaml", "servo", servo, origin)
    return folder, certificate


def main() -> int:
    """Run the command line and return its exit code."""
    a = parse()
    console = Console()
    interrupt_at_signals()
    try:
        if (a.out / "servo.yaml").exists() and not a.overwrite:
            raise ParameterError(f"{a.out} has a servo.yaml; name a new --out or give --overwrite")
        read_problem(a.problem or PROBLEM)  # before anything moves
        limits = build(
            VoltageParameters, {f.name: getattr(a, f.name) for f in fields(VoltageParameters)}
        )
        found = commission(
            Bench(a, limits, a.sensor_scale),
            console,
            lambda question: a.yes or Confirm.ask(question, console=console),
        )
    except (ParameterError, DriverError) as error:
        print(f"commission: {error}", file=sys.stderr)
        return 2
    except (NoAnswer, MeasurementError, SynthesisError) as error:
        print(f"commission: {error}", file=sys.stderr)
        return 1
    except EOFError:
        print("commission: nobody is there to answer; --yes asks nothing", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("commission: ended by a signal; the voltage is led to rest", file=sys.stderr)
        return 1
    if found is None:
        console.print("stopped; the finger is left where it is, nothing was written")
        return 1
    folder, certificate = found
    console.print(f"wrote {folder}", soft_wrap=True)
    if not certificate.met:
        problem = read_problem(folder / "problem.yaml")
        print(
            f"commission: {shortfall(certificate, problem)}. Ask what this finger can in {folder}/problem.yaml, then: "
            f"synthesize {folder}/problem.yaml --overwrite --out {folder}/feedback.yaml",
            file=sys.stderr,
        )
        return 1
    console.print("start it with")
    console.print(
        f"  ros2 run piezo_gripper servo --ros-args --params-file {folder}/servo.yaml",
        soft_wrap=True,
    )
    return 0


def parse() -> argparse.Namespace:
    """Return the command line's arguments."""
    parser = argparse.ArgumentParser(
        prog="commission", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--driver", default="simulated", help="as the servo's (%(default)s)")
    parser.add_argument("--driver-options", default="", metavar="TEXT")
    parser.add_argument(
        "--sample-time",
        type=within(float, 1e-6, 0.1),
        default=SAMPLE_TIME,
        metavar="S",
        help="(%(default)s)",
    )
    parser.add_argument("--write", choices=("immediately", "next_edge"), default="immediately")
    parser.add_argument(
        "--priority", type=within(int, 0, 99), default=80, help="real-time priority (%(default)s)"
    )
    limits = VoltageParameters()
    for name, unit in (("voltage_low", "V"), ("voltage_high", "V"), ("slew_limit", "V/s")):
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=float, default=getattr(limits, name), metavar=unit,
            help="what the finger stands (%(default)s)",
        )  # fmt: skip
    parser.add_argument(
        "--rest-voltage", type=float, default=limits.rest_voltage, metavar="V",
        help="where the finger is left alone; 0: the voltage nearest to 0 V that it stands (%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--sensor-scale", type=float, default=1.0, metavar="M",
        help="size of the sensor's scale: m per unit of the card; the sign is found (%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--amplifier-gain", type=float, default=1.0, metavar="V",
        help="V at the finger per unit that the card puts out (%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--amplifier-zero", type=float, default=0.0, metavar="U",
        help="what the card puts out for 0 V at the finger, in its unit (%(default)s)",
    )  # fmt: skip
    for name in ("card-low", "card-high"):
        parser.add_argument(
            f"--{name}", type=float, default=0.0, metavar="U",
            help="the end of what the card can put out, in its unit; both alike: not known (%(default)s)",
        )  # fmt: skip
    parser.add_argument(
        "--share",
        type=within(float, 1e-3, 1.0),
        default=0.1,
        help="of the voltage for the first steps (%(default)s)",
    )
    parser.add_argument(
        "--problem", type=Path,
        help="design problem (that of `robust`, which leaves a finger that is slower than the paper's more time)",
    )  # fmt: skip
    parser.add_argument("--out", type=output_folder, default="commissioned", help="(%(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace what is in --out")
    parser.add_argument("--yes", action="store_true", help="do not ask before each step")
    return parser.parse_args()
