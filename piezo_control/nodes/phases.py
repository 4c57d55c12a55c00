# SPDX-License-Identifier: Apache-2.0
"""The phases of a finger's state, in words, and those in which it takes no voltage yet or any more."""

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
TAKES_NONE = (FingerState.WAITING, FingerState.RAMPING, FingerState.FAULT)
