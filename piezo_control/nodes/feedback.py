# SPDX-License-Identifier: Apache-2.0
"""The block K of the paper's loop: from the deflection and the reference to the command.

in:  deflection (Sample, m), reference (Sample, m: a set-point), reference_profile (Profile, m),
     reference_waveform (Waveform, m)
out: command (Sample, m)

The newest of set-point, profile and waveform is followed. With `controller: none` the reference passes through:
open loop. A changed controller is taken whole or not at all, by `controller_file`, and takes over while the
loop runs, with the command where it was. Running free, nothing is answered before the deflections come at
the sample time that the controller was made for, and a loop that falls behind ends in a fault.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from rclpy.parameter import Parameter

from piezo_control.feedback import Feedback, FeedbackParameters, successor
from piezo_control.nodes import base
from piezo_control.nodes.block import BlockNode
from piezo_control.nodes.parameters import FeedbackNodeParameters
from piezo_control.nodes.profile_input import ProfileInput
from piezo_control.parameters import ParameterError, flatten
from piezo_control.safety import LARGEST_DEFLECTION, RateWatch
from piezo_gripper_msgs.msg import Sample

# What makes a controller; its limits of the command may change by themselves.
DESIGN = frozenset(flatten(FeedbackParameters())) - {"command_low", "command_high"}


class FeedbackNode(BlockNode):
    NAME = "feedback"
    PARAMETERS = FeedbackNodeParameters
    INPUT = "deflection"
    OUTPUT = "command"
    LARGEST = LARGEST_DEFLECTION
    MOVES_VOLTAGE = False

    def __init__(self) -> None:
        super().__init__()
        self._file = ""
        self._loading = False
        self._take_file()
        self.restart_law()
        self.reference = ProfileInput(
            self, "reference", self.parameters.sample_time, LARGEST_DEFLECTION
        )

    def refuses_while_active(self, names: set[str]) -> set[str]:
        return names & {"mode", "sample_time", "subscribers", "age_limit"}

    def check(self, parameters: FeedbackNodeParameters) -> None:
        """Refuse the half of a controller, and one that cannot take over where the loop is."""
        if parameters.controller_file not in ("", self.parameters.controller_file):
            controller = successor(parameters.controller_file, self.parameters)
            if self.active and controller.sample_time != parameters.sample_time:
                raise ParameterError(
                    f"'controller_file' is '{parameters.controller_file}', made for "
                    f"{controller.sample_time:g} s, the loop runs at {parameters.sample_time:g} s: "
                    f"deactivate '{self.NAME}' first"
                )
            if self.active:
                self._started(replace(parameters, **vars(controller)))
            return
        before, after = flatten(self.parameters), flatten(parameters)
        changed = {name for name in DESIGN if before[name] != after[name]}
        if parameters.controller == self.parameters.controller == "none":
            changed = set()  # no controller, so no half of one
        if changed and not self._loading and "name" not in changed:
            raise ParameterError(
                f"{', '.join(sorted(changed))}: part of a controller, which changes as a whole, with its "
                "'name', by 'controller_file' or in one atomic request"
            )
        if changed == {"name"} or changed == {"name", "certified"}:
            raise ParameterError(
                "'name': a controller changes as a whole, by 'controller_file' or in one atomic request"
            )
        if self.active:
            self._started(parameters)

    def restart(self) -> None:
        self.restart_law()
        self.reference.restart(self.parameters.sample_time)

    def restart_law(self) -> None:
        """Begin with the controller at rest."""
        self.law = Feedback(self.parameters)
        self.rate = RateWatch(self.parameters.sample_time)
        self.armed = self.parameters.controller == "none"

    def start(self) -> None:
        self._take_file()
        super().start()
        self.restart()
        p = self.parameters
        if p.controller != "none" and not p.certified:
            self.get_logger().warning(
                f"controller '{p.name}' ({p.controller_file or 'from parameters'}) is not certified: nothing "
                "says that the loop is stable with this finger"
            )

    def apply(self) -> None:
        if not self._take_file():
            self.law = self._started(self.parameters)

    def _started(self, parameters: FeedbackNodeParameters) -> Feedback:
        """Return the law of `parameters`, started where the loop is; ValueError when it cannot be."""
        law = Feedback(parameters)
        if self.sequence.next > 0:
            law.start(self.reference[self.sequence.next - 1], self.deflection, self.last.value)
        return law

    def _take_file(self) -> bool:
        """Take over the whole controller of `controller_file`, if that has changed."""
        name = self.parameters.controller_file
        if name in ("", self._file):
            return False
        controller = flatten(successor(name, self.parameters))
        self._file, self._loading = name, True
        changes = [
            Parameter(
                n, base.parameter_type(self.PARAMETERS, n), list(v) if isinstance(v, tuple) else v
            )
            for n, v in controller.items()
        ]
        result = self.set_parameters_atomically(changes)
        self._loading = False
        if not result.successful:
            raise ParameterError(f"{name}: {result.reason}")
        return True

    def reset(self) -> None:
        super().reset()
        self.restart_law()

    def report(self) -> tuple[str, dict[str, Any]]:
        wrong, figures = super().report()
        p = self.parameters
        return wrong, {**figures, "controller": p.name, "certified": p.certified}

    def compute(self, sample: Sample, answer: Sample) -> bool:
        self.deflection = sample.value
        if self.parameters.mode == "free_running" and not self._is_in_time():
            return False
        answer.value = self.law.step(self.reference[sample.number], sample.value)
        answer.by_controller = self.parameters.controller != "none"
        return True

    def _is_in_time(self) -> bool:
        """Say whether the loop keeps its sample time; a loop that did and no longer does is at fault."""
        if self.parameters.controller == "none":
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
