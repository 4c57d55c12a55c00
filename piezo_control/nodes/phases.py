# SPDX-License-Identifier: Apache-2.0
"""The phases of a finger's state, in words."""

from piezo_gripper_msgs.msg import FingerState

PHASES = {
    FingerState.IDLE: "idle",
    FingerState.WAITING: "waiting",
    FingerState.RUNNING: "running",
    FingerState.FINISHED: "finished",
    FingerState.FAULT: "fault",
    FingerState.HOLDING: "holding",
    FingerState.RAMPING: "ramping to rest",
}
