# SPDX-License-Identifier: Apache-2.0
"""A finger at the other end of the servo's `udp` driver: a simulated piezocantilever in real time.

Every datagram brings a voltage, which is held from then on, and is answered with the deflection measured just
before. Without a voltage for the hold time the finger ramps itself to rest, and the amplifier goes from one voltage to
the next within a slew limit of its own, sample by sample, as the hardware of a real one must: lost datagrams end in no step.
Whoever asks hears what voltage is on.
Whoever sends the first one leads the finger until it lets go or is silent for the hold time, and its numbers rise;
others are named, told so and not acted upon.
When it is stopped it says, and with --report writes, what voltages it saw.
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import struct
import sys
import threading
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import types

from piezo_control.compiled import compiled
from piezo_control.files import write_json
from piezo_control.options import output_file, port, within
from piezo_control.parameters import ParameterError, build, load
from piezo_control.safety import RAMP_PERIOD, SafetyParameters, VoltageParameters, toward
from piezo_control.servo.clock import Clock, become_real_time, clock_of, now
from piezo_control.start import stop_at_signals
from piezo_sim.driver import Device, device_of, read, write
from piezo_sim.plant.cantilever import CantileverParameters

PORT = 9750
WORD, ASKS = struct.unpack("<qq", b"PZG1\0\0\0\0PZG?\0\0\0\0")
CARD = {"amplifier.slew_limit": VoltageParameters().slew_limit}
"""Of a cantilever whose file has none."""
SIZE = 24  # bytes of a datagram: word, number, value

_recvfrom: Any = types.ExternalFunction(
    "recvfrom",
    types.intp(types.int32, types.intp, types.intp, types.int32, types.intp, types.intp),
)
_sendto: Any = types.ExternalFunction(
    "sendto", types.intp(types.int32, types.intp, types.intp, types.int32, types.intp, types.uint32)
)


class Line(NamedTuple):
    """The socket, one datagram as integers and as floats in the same memory, and who sent it."""

    socket: int
    scale: float  # the sensor's: its unit per m, and its reading at 0 m
    zero: float
    integers: np.ndarray
    floats: np.ndarray
    address: np.ndarray
    length: np.ndarray
    leader: np.ndarray  # address of the one who leads the finger, 0: nobody
    stray: np.ndarray  # of the last one who was refused


class Seen(NamedTuple):
    """What the finger saw; arrays of one number."""

    samples: np.ndarray
    lost: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    step: np.ndarray  # largest change from one voltage to the next
    output_step: np.ndarray  # largest change of the amplifier in a sample of the plant
    number: np.ndarray
    ramps: np.ndarray  # how often nothing came for the hold time
    refused: np.ndarray  # datagrams of others, and of numbers that do not rise


@dataclass(frozen=True)
class Report:
    """What a finger saw, V."""

    samples: int
    lost_datagrams: int
    lowest_voltage: float
    highest_voltage: float
    largest_step: float
    largest_output_step: float
    last_voltage: float
    own_ramps: int
    refused_datagrams: int


def serve(
    line: Line, device: Device, clock: Clock, seen: Seen, hold: int, step: float, stop: np.ndarray
) -> None:
    """Answer datagrams until `stop`; after `hold` ns without one go `step` (V) per ramp period to rest."""
    heard = ramped = reached = now(clock)
    rest = device.plant.amplifier.rest
    output = device.state.amplifier.voltage
    while stop[0] == 0:
        line.length[0] = 128
        size = _recvfrom(
            line.socket, line.integers.ctypes.data, SIZE, 0, line.address.ctypes.data,
            line.length.ctypes.data,
        )  # fmt: skip
        instant = now(clock)
        while reached < instant:
            reached = min(reached + device.period, instant)
            before = output[0]
            read(device, reached)
            seen.output_step[0] = max(seen.output_step[0], abs(output[0] - before))
        if size == SIZE and line.integers[0] == WORD:
            voltage = line.floats[2]
            number = line.integers[1]
            sender = line.address[0]  # family, port and address
            if number == 0:
                if sender == line.leader[0]:
                    line.leader[0] = 0
                continue
            if line.leader[0] == 0 or instant - heard > hold:
                line.leader[0] = sender
                seen.number[0] = min(seen.number[0], number - 1)
            if sender != line.leader[0] or number <= seen.number[0]:
                seen.refused[0] += 1.0
                if sender != line.leader[0]:
                    line.stray[0] = sender
                    line.integers[1] = 0
                    answer(line)
                continue
            if seen.samples[0] > 0.0:
                seen.lost[0] += number - seen.number[0] - 1
            seen.step[0] = max(seen.step[0], abs(voltage - device.demand[0]))
            heard = instant
            seen.number[0] = number
            seen.samples[0] += 1.0
            seen.lowest[0] = min(seen.lowest[0], voltage)
            seen.highest[0] = max(seen.highest[0], voltage)
            line.floats[2] = line.zero + line.scale * device.reading[0]
            answer(line)
            write(device, voltage, instant)
            continue
        if size == SIZE and line.integers[0] == ASKS:
            line.floats[2] = output[0]
            answer(line)
        # In time, however often somebody asks meanwhile.
        share = min(1.0, (instant - ramped) * 1e-9 / RAMP_PERIOD)
        ramped = instant
        if instant - heard > hold and device.demand[0] != rest:
            if heard > 0:
                seen.ramps[0] += 1.0
                heard = 0  # counted
            write(device, toward(rest, step * share, device.demand[0]), instant)


def answer(line: Line) -> None:
    """Send the datagram to whom the last one came from."""
    _sendto(
        line.socket, line.integers.ctypes.data, SIZE, 0, line.address.ctypes.data, line.length[0]
    )  # fmt: skip


class UdpFinger:
    """The finger in a thread of its own, bound to a UDP port of an address.

    Its sensor says ``zero + scale * deflection`` (`scale` per m).

    Raises OSError when the port cannot be had, UnicodeError for a host that cannot be a name in a network.
    """

    def __init__(
        self,
        plant: CantileverParameters,
        host: str = "127.0.0.1",
        port: int = 0,
        safety: SafetyParameters | None = None,
        priority: int = 0,
        scale: float = 1.0,
        zero: float = 0.0,
    ) -> None:
        [*_, address] = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(address)
        timeout = struct.pack("ll", 0, round(RAMP_PERIOD * 1e6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)
        self.port = self._socket.getsockname()[1]
        safety = safety or SafetyParameters()
        datagram = np.zeros(3, dtype=np.int64)
        self._line = Line(
            self._socket.fileno(), scale, zero, datagram, datagram.view(float), np.zeros(16, dtype=np.int64),
            np.zeros(1, dtype=np.uint32), np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64),
        )  # fmt: skip
        self._device = device_of(plant)
        self._seen = Seen(*(np.zeros(1) for _ in Seen._fields))
        self._stop = np.ones(1, dtype=np.int64)
        self._arguments = (
            self._line, self._device, clock_of(plant.sample_time, 0.0), self._seen,
            round(safety.hold_time * 1e9), safety.ramp * RAMP_PERIOD, self._stop,
        )  # fmt: skip
        self._priority = priority
        self._thread = threading.Thread(target=self._work, name="finger")

    def start(self) -> None:
        """Compile what answers, if that was not done before, and begin to answer."""
        compiled(serve)(*self._arguments)
        self._stop[0] = 0
        self._thread.start()

    def _work(self) -> None:
        become_real_time(self._priority, -1)
        compiled(serve)(*self._arguments)

    @property
    def stray(self) -> str:
        """Who was refused last, because somebody else leads the finger; empty: nobody."""
        raw = self._line.stray.tobytes()
        _, port = struct.unpack(">HH", raw[:4])
        return f"{socket.inet_ntoa(raw[4:])}:{port}" if any(raw) else ""

    def stop(self) -> Report:
        """Answer no more; return what was seen."""
        self._stop[0] = 1
        self._thread.join()
        self._socket.close()
        seen = self._seen
        return Report(
            samples=int(seen.samples[0]),
            lost_datagrams=int(seen.lost[0]),
            lowest_voltage=float(seen.lowest[0]),
            highest_voltage=float(seen.highest[0]),
            largest_step=float(seen.step[0]),
            largest_output_step=float(seen.output_step[0]),
            last_voltage=float(self._device.written[0]),
            own_ramps=int(seen.ramps[0]),
            refused_datagrams=int(seen.refused[0]),
        )


def main() -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (%(default)s)")
    parser.add_argument(
        "--port", type=port, default=PORT, metavar="N",
        help="UDP port, 0: any that is free (%(default)s)",
    )  # fmt: skip
    parser.add_argument("--cantilever", metavar="FILE", help="parameter file of a cantilever")
    parser.add_argument(
        "--report", type=output_file, metavar="FILE", help="where to write what was seen, as JSON"
    )
    parser.add_argument(
        "--priority",
        type=within(int, 0, 99),
        default=0,
        metavar="N",
        help="of the real-time scheduler, 0 … 99, 0: ordinary (%(default)s)",
    )
    parser.add_argument(
        "--scale", type=float, default=1.0, help="sensor: its unit per m (%(default)s)"
    )
    parser.add_argument("--zero", type=float, default=0.0, help="sensor: at 0 m (%(default)s)")
    arguments = parser.parse_args()
    stop = stop_at_signals()
    try:
        if not (
            math.isfinite(arguments.scale) and arguments.scale and math.isfinite(arguments.zero)
        ):
            raise ParameterError(
                f"--scale is {arguments.scale:g}, must be finite and not 0; --zero is {arguments.zero:g}, must be finite"
            )
        file = arguments.cantilever
        plant = build(CantileverParameters, CARD | (load(file, "cantilever") if file else {}), file)
        finger = UdpFinger(
            plant, arguments.host, arguments.port, None, arguments.priority, arguments.scale,
            arguments.zero,
        )  # fmt: skip
        finger.start()
    except (ParameterError, OSError, UnicodeError) as error:
        print(f"udp_finger: {error}", file=sys.stderr)
        return 2
    print(f"udp_finger: answers at {arguments.host}:{finger.port}", flush=True)
    told = ""
    while not stop.wait(1.0):
        if finger.stray != told:
            told = finger.stray
            print(f"udp_finger: {told} is refused: somebody else leads this finger", flush=True)
    report = asdict(finger.stop())
    print(json.dumps(report))
    if arguments.report:
        try:
            write_json(arguments.report, report)
        except OSError as error:
            print(f"udp_finger: --report {arguments.report}: {error.strerror}", file=sys.stderr)
            return 1
    return 0
