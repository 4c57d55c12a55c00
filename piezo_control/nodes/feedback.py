# SPDX-License-Identifier: Apache-2.0
"""The block K of the paper's loop: from the deflection and the reference to the command.

in:  deflection (Sample, m), reference (Sample, m: a set-point), reference_profile (Profile, m),
     reference_waveform (Waveform, m), expected (Sample, m) with `force_control`: the deflection of a tip that
     nobody pushes, dynamics (Dynamics): how the tip gives way, by the feedforward's file, and whether
     it undoes what the temperature does, for which some certificates ask
out: command (Sample, m), reference_followed_profile (Profile, m), reference_followed_waveform (Waveform, m),
     push (Sample, N) with `force_control`: the force of an object, as estimated

The newest of set-point, profile and waveform is followed; one that is started again stays at the reference of `state`, and what it is is said with the stamp of the first
sample at which it is. With `controller: none` the reference passes through:
open loop. A changed controller is taken whole or not at all, by `controller_file`, and takes over while the
loop runs, with the command where it was; limits of the command and preview that are given with the file count
instead of the file's. With `force_control`, in place of the controller, the loop follows the
reference as long as the tip pushes with no more than the profile's `max_force` and its own `touch.force_limit`,
and holds that force where something is in the way (:mod:`piezo_control.touch`). With `preview_band` profiles and
waveforms are followed without lag, as far as the controller's band goes (:mod:`piezo_control.design.preview`).
Running free, nothing is answered before the deflections come at the sample time that the controller was made for,
and a loop that falls behind ends in a fault.
"""

from __future__ import annotations

import math
import time
from collections.abc import Set
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from piezo_control.design.preview import asked
from piezo_control.design.touching import check_stable
from piezo_control.dynamics import DynamicsParameters
from piezo_control.feedback import (
    TEMPERATURE_REMAINS,
    Feedback,
    FeedbackParameters,
    controller_file,
    is_limited,
    successor,
)
from piezo_control.nodes import base
from piezo_control.nodes.block import BlockNode, command_range
from piezo_control.nodes.parameters import FeedbackNodeParameters
from piezo_control.nodes.phases import TAKES_NONE
from piezo_control.nodes.profile_input import ProfileInput
from piezo_control.nodes.qos import DELIVERY_TIMEOUT, LATCHED, SAMPLE
from piezo_control.parameters import ParameterError, build, flatten
from piezo_control.profile import SampledSignal
from piezo_control.safety import LARGEST_DEFLECTION, RateWatch, is_physical
from piezo_control.touch import Touch
from piezo_gripper_msgs.msg import Dynamics, FingerState, Sample

PUSH_PERIOD = 1e-2  # s, between two of the push

CONTROLLER = frozenset(flatten(FeedbackParameters()))
# What makes a controller; its limits of the command and its preview may change by themselves.
DESIGN = CONTROLLER - {"command_low", "command_high", "preview_band"}


def refuse_half(path: str, parameters: FeedbackNodeParameters, names: Set[str]) -> None:
    """Raise ParameterError for those of the `names` that are not as in the controller of the file."""
    whole, given = flatten(successor(path, parameters)), flatten(parameters)
    if half := sorted(name for name in names if whole[name] != given[name]):
        raise ParameterError(
            f"{', '.join(half)}: part of a controller, which changes as a whole, and not as in that of "
            f"'controller_file' ({path})"
        )


class FeedbackNode(BlockNode):
    NAME = "feedback"
    PARAMETERS = FeedbackNodeParameters
    INPUT = "deflection"
    OUTPUT = "command"
    LARGEST = LARGEST_DEFLECTION
    MOVES_VOLTAGE = False

    def __init__(self) -> None:
        super().__init__()
        self._pushes: Publisher | None = None
        self.expected = Sample()
        self._expected_at = -math.inf
        self._expectations: Subscription | None = None
        self.touch: Touch | None = None  # before the tip's dynamics are known
        self.dynamics: DynamicsParameters | None = None
        self._undoes_temperature = True  # the feedforward, as long as none says that it does not
        self.create_subscription(Dynamics, "dynamics", self._on_dynamics, LATCHED)
        self._is_held = False
        """Whether the finger is where the last answer left it, while this node is inactive."""
        self._file = ""
        self._unreadable = ""
        """Why the file of the controller that is asked for cannot be taken."""
        self.add_pre_set_parameters_callback(self._with_file)
        self._begin_with_file()
        self.restart_law()
        self.reference = ProfileInput(
            self,
            "reference",
            self.parameters.sample_time,
            LARGEST_DEFLECTION,
            self._look_ahead,
            says=True,
        )
        self._look_ahead()

    def refuses_while_active(self, names: set[str]) -> set[str]:
        fixed = {"mode", "subscribers", "age_limit", "force_control"}
        return {name for name in names if name in fixed or name.startswith("touch.")}

    def _validate(self, changes: list[Parameter]) -> SetParametersResult:
        # The name of a file may stay, and what stands in it not.
        reason, self._unreadable = self._unreadable, ""
        if reason:
            return SetParametersResult(successful=False, reason=reason)
        return super()._validate(changes)

    def check(self, parameters: FeedbackNodeParameters) -> None:
        """Refuse the half of a controller, and one that cannot take over where the loop is."""
        if self.active:
            self._touching(parameters)
        before, after = flatten(self.parameters), flatten(parameters)
        changed = {name for name in DESIGN if before[name] != after[name]}
        if self.active and "sample_time" in changed:
            raise ParameterError(
                f"controller '{parameters.name}' is made for {parameters.sample_time:g} s, the loop runs at "
                f"{self.parameters.sample_time:g} s: deactivate '{self.NAME}' first"
            )
        if path := parameters.controller_file:
            if changed or path != self.parameters.controller_file:
                refuse_half(path, parameters, DESIGN)
        else:
            self._check_single(parameters, changed)
        if self.active:
            self._started(parameters)

    def _check_single(self, parameters: FeedbackNodeParameters, changed: set[str]) -> None:
        """Refuse the half of a controller that comes from no file, and a certificate for one, given its changes."""
        if parameters.controller == self.parameters.controller == "none":
            return  # no controller, so no half of one
        if changed and "name" not in changed or changed in ({"name"}, {"name", "certified"}):
            raise ParameterError(
                f"{', '.join(sorted(changed))}: part of a controller, which changes as a whole, with its "
                "'name', by 'controller_file' or in one atomic request"
            )
        if self.active and changed and parameters.certified:
            raise ParameterError(
                "'certified' is true: single parameters bring no certificate; take the controller by "
                "'controller_file', or set 'certified' to false with them"
            )

    def restart(self) -> None:
        self.restart_law()
        self.reference.restart(self.parameters.sample_time)
        self._look_ahead()

    def _look_ahead(self) -> None:
        """Prepare what the controller is asked for the reference that is followed from now on."""
        p = self.parameters
        self.asked = SampledSignal(asked(self.reference.signal, p), p.sample_time)

    def restart_law(self) -> None:
        """Begin with the controller at rest."""
        p = self.parameters
        self.law = Feedback(p)
        self.touch = self._touching(p)
        self._begin_to_watch()

    def _wait_at_rest(self) -> None:
        """Begin anew with each sample of a finger that takes no voltage, so that no law winds up against it."""
        self.law.reset()
        if self.touch:
            self.touch.reset()

    def _begin_to_watch(self) -> None:
        """See anew whether the loop keeps its sample time."""
        self.rate = RateWatch(self.parameters.sample_time)
        self.armed = not self._has_a_rate()

    def _may_go_on(self) -> bool:
        """Say whether an activation finds the finger held where the last answer left it.

        The law then goes on from there: one that began at rest would let go of what the finger holds.
        """
        before, now = self.law.parameters, self.parameters
        fixed = ("mode", "sample_time", "force_control")
        is_same = all(getattr(before, name) == getattr(now, name) for name in fixed)
        return is_same and self._is_held and not self.guard.is_latched

    def _touching(self, p: FeedbackNodeParameters) -> Touch | None:
        """Return the law of a finger that feels; raise ParameterError for one that would swing itself up."""
        tip = self.dynamics
        if not p.force_control or tip is None:
            return None
        law = Touch(p.touch, tip.elastic_constant, p.sample_time, p.command_low, p.command_high)
        check_stable(p.touch, tip, p.sample_time, p.delay_samples)
        return law

    def _on_dynamics(self, told: Dynamics) -> None:
        """Take over how the tip gives way; what the finger feels meanwhile stays."""
        values = {
            "denominator": list(told.denominator),
            "elastic_constant": told.elastic_constant,
        }
        self.dynamics = None
        before = self._objection()
        self._undoes_temperature = bool(told.denominator)
        if self.active and self._objection() != before:
            self._warn()
        if not self._undoes_temperature:
            self.touch = None
            return
        try:
            self.dynamics = build(DynamicsParameters, values, self.resolve_topic_name("dynamics"))
            self._feel_on()
        except ParameterError as error:
            self.touch = None
            if self.active:
                self.trip(str(error))
            return
        self.go_on()

    def _feel_on(self) -> None:
        """Let the law of a finger that feels be that of the parameters; its state stays."""
        law = self._touching(self.parameters)
        if self.touch and law:
            law.state = self.touch.state
        self.touch = law

    def _has_a_rate(self) -> bool:
        """Say whether the law is made for one sample time."""
        return self.parameters.controller != "none" or self.parameters.force_control

    def start(self) -> None:
        self._say_origin()
        run = self.sequence if self._may_go_on() else None
        super().start()
        if run:
            self.sequence = run
            self._begin_to_watch()
            self.apply()
        else:
            self.restart()
        p = self.parameters
        if p.force_control:
            self.expected = Sample()
            self._expected_at = -math.inf
            self._expectations = self.create_subscription(
                Sample, "expected", self._on_expected, LATCHED
            )
            # A finger that has this topic is taken for one that feels.
            self._pushes = self.create_publisher(Sample, "push", SAMPLE)
        self._warn()

    def _warn(self) -> None:
        """Say that a controller that is to run has no certificate, or what that does not cover."""
        p = self.parameters
        if p.controller != "none" and not (p.certified or p.force_control):
            self.get_logger().warning(
                f"controller '{p.name}' ({p.controller_file or 'from parameters'}) is not certified: nothing "
                "says that the loop is stable with this finger"
            )
        if objection := self._objection():
            self.get_logger().warning(f"controller '{p.name}': {objection}")

    def _objection(self) -> str:
        """Return what the certificate does not cover with the feedforward that is there; empty: nothing."""
        p = self.parameters
        is_undone = self._undoes_temperature or p.force_control or not p.temperature_undone
        return "" if is_undone else TEMPERATURE_REMAINS

    def stop(self) -> None:
        if self._expectations and self._pushes:
            self.destroy_subscription(self._expectations)
            self.destroy_publisher(self._pushes)
            self._expectations = self._pushes = None
        self.answers.finish(DELIVERY_TIMEOUT)
        self._is_held = self.sequence.next > 0 and self._holds()

    def _on_state(self, state: FingerState) -> None:
        super()._on_state(state)
        self._is_held = self._is_held and self._holds()

    def _holds(self) -> bool:
        """Say whether the finger's state tells of no way to rest and no new run."""
        held = (FingerState.RUNNING, FingerState.HOLDING)
        return self.finger is not None and self.finger.phase in held

    def apply(self) -> None:
        self._say_origin()
        law = self._started(self.parameters)
        if law.parameters != self.law.parameters:
            self._warn()
        self.law = law
        self._feel_on()
        self._look_ahead()

    def _started(self, parameters: FeedbackNodeParameters) -> Feedback:
        """Return the law of `parameters`, started where the loop is; ValueError when it cannot be."""
        if parameters == self.law.parameters:
            return self.law
        law = Feedback(parameters)
        if self.sequence.next > 0:
            law.start(self.asked[self.sequence.next - 1], self.deflection, self.last.value)
        return law

    def _with_file(self, changes: list[Parameter]) -> list[Parameter]:
        """Return `changes` with the whole controller of a file that they name; what else they name stays as it is.

        A controller that comes by single parameters is of no file.
        """
        values = {p.name: p.value for p in changes}
        if "controller_file" not in values:
            is_other = values.get("name", self.parameters.name) != self.parameters.name
            return [*changes, *([Parameter("controller_file", value="")] if is_other else [])]
        if not isinstance(path := values["controller_file"], str) or not path:
            return changes
        try:
            controller = flatten(successor(path, self.parameters))
        except ParameterError as error:
            self._unreadable = str(error)
            return changes
        types = {n: base.parameter_type(self.PARAMETERS, n) for n in controller.keys() - values}
        return [*changes, *(Parameter(n, kind, controller[n]) for n, kind in types.items())]

    def _begin_with_file(self) -> None:
        """Take over the controller of the file that was given at start, with what was given beside it."""
        given = self._parameter_overrides.keys() & CONTROLLER
        if path := self.parameters.controller_file:
            refuse_half(path, self.parameters, given & DESIGN)
            result = self.set_parameters_atomically(
                [Parameter("controller_file", value=path), *map(self.get_parameter, given)]
            )
            if not result.successful:
                raise ParameterError(result.reason)
            self._say_origin()

    def _say_origin(self) -> None:
        """Say where a controller comes from that is of another file than the last one."""
        path = self.parameters.controller_file
        if path != self._file:
            self._file = path
            self.comes_from("controller", controller_file(path) if path not in ("", "none") else "")

    def reset(self) -> None:
        was_latched = self.guard.is_latched
        super().reset()
        if was_latched:  # a finger that runs goes on as it is
            self.restart_law()

    def report(self) -> tuple[str, dict[str, Any]]:
        wrong, figures = super().report()
        p = self.parameters
        figures |= {"controller": p.name, "certified": p.certified, **command_range(p)}
        figures |= {"not covered": self._objection()}
        if p.force_control:
            push = self.touch.push if self.touch else math.nan
            figures |= {"controller": "force control", "certified": False, "push": push}
        return wrong, figures

    def _on_expected(self, expected: Sample) -> None:
        if not is_physical(expected.value, LARGEST_DEFLECTION):
            self.get_logger().error(
                f"'expected' sample {expected.number} is {expected.value}, must be finite and within "
                f"±{LARGEST_DEFLECTION:g} m; ignored",
                throttle_duration_sec=1.0,
            )
            return
        self.expected = expected
        self._expected_at = time.monotonic()
        self.go_on()

    def prepare(self, sample: Sample) -> str:
        """See to what is expected of this sample; sample 0 is that of a finger at rest."""
        if not self.parameters.force_control:
            return ""
        if sample.number == 0:
            self.expected = Sample()
        if self.touch is None:
            return self._told_by("dynamics")
        return "" if self.expected.number == sample.number else self._told_by("expected")

    def compute(self, sample: Sample, answer: Sample) -> bool:
        self.deflection = sample.value
        if self.parameters.mode == "free_running":
            if not self._is_in_time():
                return False
            if self.finger and self.finger.phase in TAKES_NONE:
                self._wait_at_rest()
        if self.finger and not self.reference.is_known:
            # Those of a feedback before this one.
            self.reference.hold(self.finger.reference, self.finger.max_force)
        self.reference.say(sample.header)
        p, reference = self.parameters, self.reference[sample.number]
        answer.by_controller = self._has_a_rate()
        if not p.force_control:
            answer.value = self.law.step(self.asked[sample.number], sample.value)
        elif self._is_expected() and self.touch:
            answer.value = self.touch.step(
                reference,
                sample.value,
                self.expected.value,
                self.reference.max_force or math.inf,
            )
            self._tell_push(sample, self.touch.push)
        else:
            return False
        answer.limited = is_limited(p, answer.value, reference, answer.by_controller)
        return True

    def _tell_push(self, sample: Sample, value: float) -> None:
        """Tell the push of the object, not at every sample."""
        if (
            self._pushes
            and sample.number % max(1, round(PUSH_PERIOD / self.parameters.sample_time)) == 0
        ):
            push = Sample(header=sample.header, number=sample.number, period=PUSH_PERIOD)
            push.value = value
            self._pushes.publish(push)

    def _told_by(self, topic: str) -> str:
        """Return in words which topic of the feedforward is missing."""
        topic = self.resolve_topic_name(topic)
        return f"'{topic}': runs 'feedforward' with `compensator: sensorless`?"

    def _is_expected(self) -> bool:
        """Say whether what is expected is known: in lock-step it is, running free it may be too old."""
        if self.parameters.mode == "lockstep":
            return True
        now = time.monotonic()
        if self._expected_at == -math.inf:
            self._expected_at = now  # the feedforward is heard once it has a command
        age, limit = now - self._expected_at, self.parameters.age_limit
        missing = "expected" if self.touch else "dynamics"
        if age > limit:
            self.trip(
                f"no news for {age:.2g} s, must be within {limit:g} s, of {self._told_by(missing)}"
            )
        return age <= limit

    def _is_in_time(self) -> bool:
        """Say whether the loop keeps its sample time; a loop that did and no longer does is at fault."""
        if not self._has_a_rate():
            return True
        period = self.rate.see(time.monotonic())
        if not period:
            return self.armed
        if self.rate.is_right(period):
            self.armed = True
            return True
        text = (
            f"'{self.INPUT}' comes every {period * 1e3:.3g} ms, controller '{self.parameters.name}' was made "
            f"for {self.parameters.sample_time * 1e3:g} ms"
        )
        if self.armed:
            self.trip(text)
        else:
            self.get_logger().error(f"{text}; not answered", throttle_duration_sec=1.0)
        return False


def main() -> int:
    return base.run(FeedbackNode)
