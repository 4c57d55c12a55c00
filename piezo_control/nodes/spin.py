# SPDX-License-Identifier: Apache-2.0
"""How every node of the package waits: one thread, one queue of events, a stop that can still publish.

`rclpy.executors.SingleThreadedExecutor` rebuilds a wait set with every entity of the node for each
message and spends half to two thirds of a hop there. `EventsExecutor` (public in Jazzy from rclpy
7.1.4) is told by the middleware which entity has work and is as quick as a bare wait on one
subscription, while parameters, services and timers stay alive in the same thread. It is driven by
`spin_once`, so that Python sees signals between events.

rclpy's own signal handlers shut the context down at once, and nothing could ramp a voltage to 0 V any
more. Here a signal only ends the loop; the node is then shut down through its lifecycle, with its
publishers still alive.
"""

from __future__ import annotations

import gc
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

LONGEST_WAIT = 0.1  # s: how soon an idle node sees a signal


def init(args: list[str] | None = None) -> None:
    """Start rclpy for a node that `spin` runs: no signal handlers, publishing in the caller's thread.

    A synchronous publish saves the hand-over to the middleware's sender thread, about a twentieth of
    a hop; RMW_FASTRTPS_PUBLICATION_MODE overrides it.
    """
    os.environ.setdefault("RMW_FASTRTPS_PUBLICATION_MODE", "SYNCHRONOUS")
    # The first line of a log asks from which of all modules it comes, which takes 0.1 s and more. A finger that said
    # "running" for the first time was late by that, which its neighbours took for a fault. Asked here, it is known then.
    inspect.getframeinfo(sys._getframe())
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)


@contextmanager
def serving(nodes: Sequence[Node]) -> Iterator[Callable[[Callable[[], bool]], None]]:
    """Give `serve(done)`, which serves the events of `nodes` in this thread until `done()`.

    `done` is looked at after every event. What has been taken off the network and waits for its turn when
    `serve` ends is served by the next one, so that a request in front of a signal is still answered.
    """
    gc.freeze()  # modules and entities stay; the collector need not visit them between samples
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)

    def serve(done: Callable[[], bool]) -> None:
        while not done():
            executor.spin_once(timeout_sec=LONGEST_WAIT)

    try:
        yield serve
    finally:
        executor.shutdown()
