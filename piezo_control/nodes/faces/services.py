# SPDX-License-Identifier: Apache-2.0
"""What somebody at the bench asks of the gripper, as services (std_srvs/Trigger).

~/home: to the opening at rest, deflection 0 of both fingers; ~/release: to the widest opening;
~/stop: hold the fingers where they are, accepted always; ~/zero: take the present deflections for 0
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from std_srvs.srv import Trigger

from piezo_control.gripper import reach
from piezo_control.nodes.faces.asker import Asker

if TYPE_CHECKING:
    from piezo_control.nodes.gripper import GripperNode


class Services(Asker):
    """Serves them; an answer that does not say success says why not. Motions have begun, not ended, then."""

    def __init__(self, gripper: GripperNode) -> None:
        self._gripper = gripper
        self._services = [
            gripper.create_service(Trigger, f"~/{name}", self._answer(act))
            for name, act in {
                "home": self._home,
                "release": self._release,
                "stop": self._stop,
                "zero": self._gripper.zero,
            }.items()
        ]

    def destroy(self) -> None:
        """Let go of the services."""
        for service in self._services:
            self._gripper.destroy_service(service)

    def _answer(
        self, act: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def callback(_: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
            try:
                answer.message, answer.success = act(), True
            except ValueError as error:
                answer.message, answer.success = str(error), False
            return answer

        return callback

    def _home(self) -> str:
        return self._go_to(self._gripper.parameters.rest_opening)

    def _release(self) -> str:
        return self._go_to(reach(self._gripper.parameters)[1])

    def _go_to(self, opening: float) -> str:
        self._gripper.move(self._gripper.check_goal(opening, 0.0, 0.0), self)
        return f"on the way to {opening * 1e6:g} µm"

    def _stop(self) -> str:
        was_moving = self._gripper.asker is not None
        self._gripper.halt("stopped")
        return "stopped" if was_moving else "nothing was moving"
