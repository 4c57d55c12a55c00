# SPDX-License-Identifier: Apache-2.0
"""Starts the executables: Ctrl-C during the second that their imports take ends them without a traceback."""

from __future__ import annotations

import importlib
import signal
from collections.abc import Callable


def executable(module: str) -> Callable[[], int]:
    """Return a function that imports `module` and runs its `main`."""

    def start() -> int:
        # Nothing moves a finger yet; what does sets handlers of its own that bring it to rest.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        return importlib.import_module(module).main()

    return start


commission = executable("piezo_control.servo.commission")
export = executable("piezo_control.export.cli")
feedback = executable("piezo_control.nodes.feedback")
fingerctl = executable("piezo_control.nodes.fingerctl")
feedforward = executable("piezo_control.nodes.feedforward")
gripper = executable("piezo_control.nodes.gripper")
identify = executable("piezo_control.identification.cli")
panel = executable("piezo_control.nodes.panel")
recorder = executable("piezo_control.nodes.recorder")
synthesize = executable("piezo_control.design.cli")
servo = executable("piezo_control.nodes.servo")
