# SPDX-License-Identifier: Apache-2.0
"""Temperature of the workspace over time, on the grid n * period.

Every profile is a function of the grid index alone: the same parameters give the same value of sample n,
whatever was asked before. The plant holds grid value n from n * period to (n + 1) * period.

spotlight: a lamp (the paper's Fig. 2) is on for `on_time` at the start of every `repeat_time`; the air
follows the lamp with first-order `time_constant` (closed form, geometric series over the past pulses).
random_walk: an Ornstein-Uhlenbeck walk, T[n+1] = base + a (T[n] - base) + amplitude sqrt(1 - a²) N(0, 1),
a = exp(-period / time_constant), so that `amplitude_degc` is its standard deviation in the long run.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from piezo_control.identification.columns import QUANTITIES
from piezo_control.identification.table import TableError, read_columns
from piezo_control.parameters import ParameterError, parameter

COLUMNS = {name: QUANTITIES[name] for name in ("time", "temperature")}  # of a table
PROFILES = ("constant", "step", "ramp", "sine", "spotlight", "random_walk", "replay")
LONGEST_WALK = 10**8  # values


@dataclass(frozen=True)
class TemperatureParameters:
    """Profile of the temperature; values that a profile does not name are not used by it."""

    profile: str = parameter("constant", "shape over time", choices=PROFILES)
    period: float = parameter(1e-3, "spacing of the grid", unit="s", low=1e-6, high=3600.0)
    base_degc: float = parameter(
        22.0,
        "temperature before the change or around which it moves",
        unit="degC",
        low=-50,
        high=150,
    )
    amplitude_degc: float = parameter(
        10.0,
        "height of step, ramp, sine or spotlight; standard deviation of the random walk",
        unit="degC",
        low=-100.0,
        high=100.0,
    )
    start: float = parameter(
        0.0, "begin of step, ramp, sine and spotlight", unit="s", low=0.0, high=1e9
    )
    duration: float = parameter(10.0, "time the ramp takes", unit="s", low=1e-6, high=1e9)
    frequency_hz: float = parameter(0.1, "frequency of the sine", unit="Hz", low=0.0, high=1e6)
    on_time: float = parameter(5.0, "time the spotlight is on", unit="s", low=0.0, high=1e9)
    repeat_time: float = parameter(
        10.0, "time from pulse to pulse of the spotlight", unit="s", low=1e-6, high=1e9
    )
    time_constant: float = parameter(
        2.0, "lag of spotlight and random walk", unit="s", low=1e-6, high=1e9
    )
    seed: int = parameter(1, "seed of the random walk", low=0, high=2**63 - 1)
    file: str = parameter(
        "", "replay: a CSV with the columns time (s), temperature (degC), or a bag folder"
    )
    topic: str = parameter(
        "/temperature", "replay of a bag: topic of type sensor_msgs/msg/Temperature"
    )

    def __post_init__(self) -> None:
        if self.profile == "spotlight" and self.on_time > self.repeat_time:
            raise ParameterError(
                f"'on_time' is {self.on_time} s, must be at most 'repeat_time' = {self.repeat_time} s"
            )
        if self.profile == "replay" and not self.file:
            raise ParameterError("'file' is empty, the profile 'replay' needs a CSV or a bag")


def temperature(parameters: TemperatureParameters, first: int, count: int) -> np.ndarray:
    """Return the temperatures (°C) number first ... first + count - 1 of the grid, shape (count,).

    Raises ParameterError naming file, column and row when a replayed file cannot be used.
    """
    p = parameters
    if p.profile == "random_walk":
        return _random_walk(p, first + count)[first:]
    time = np.arange(first, first + count) * p.period
    if p.profile == "replay":
        try:
            changed = Path(p.file).stat().st_mtime_ns
        except OSError as error:
            raise ParameterError(f"{p.file}: cannot be read: {error}") from None
        return np.interp(time, *_recording(p.file, p.topic, changed))
    return p.base_degc + p.amplitude_degc * _shape(p, time - p.start)


def _shape(p: TemperatureParameters, time: np.ndarray) -> np.ndarray:
    """Return the profile between 0 and 1 (sine: -1 and 1); `time` counts from its begin."""
    since = np.maximum(time, 0.0)
    if p.profile == "step":
        return (time >= 0.0).astype(float)
    if p.profile == "ramp":
        return np.minimum(since / p.duration, 1.0)
    if p.profile == "sine":
        return np.sin(2.0 * math.pi * p.frequency_hz * since)
    if p.profile == "spotlight":
        pulse, phase = np.divmod(since, p.repeat_time)
        decay = math.exp(-p.repeat_time / p.time_constant)
        heated = -math.expm1(-p.on_time / p.time_constant)
        after_pulse = heated * math.exp(-(p.repeat_time - p.on_time) / p.time_constant)
        at_begin = after_pulse * (1.0 - decay**pulse) / (1.0 - decay)
        lit = -np.expm1(-np.minimum(phase, p.on_time) / p.time_constant)
        cooling = np.exp(-np.maximum(phase - p.on_time, 0.0) / p.time_constant)
        return at_begin * np.exp(-phase / p.time_constant) + lit * cooling
    return np.zeros_like(time)


def _random_walk(p: TemperatureParameters, count: int) -> np.ndarray:
    """Return the walk from its begin, at least `count` values computed once in whole blocks."""
    if count > LONGEST_WALK:
        raise ParameterError(
            f"'profile' is 'random_walk', which is computed from its begin: {count} values were asked for, must "
            f"be at most {LONGEST_WALK}"
        )
    blocks = max(1, math.ceil(math.log2(max(count, 1) / 4096)) + 1)
    return p.base_degc + _walk(p.seed, p.period, p.time_constant, 4096 * 2**blocks)[:count] * (
        p.amplitude_degc
    )


@functools.lru_cache(maxsize=4)
def _walk(seed: int, period: float, time_constant: float, count: int) -> np.ndarray:
    kept = math.exp(-period / time_constant)
    draws = np.random.Generator(np.random.PCG64(seed)).standard_normal(count)
    steps = (math.sqrt(1.0 - kept * kept) * draws).tolist()
    value = 0.0
    walk = np.empty(count)
    for n in range(count):
        walk[n] = value
        value = kept * value + steps[n]
    return walk


@functools.lru_cache(maxsize=4)
def _recording(file: str, topic: str, changed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return time (s) and temperature (°C); `changed` tells one state of the file from another."""
    path = Path(file)
    return _read_bag(path, topic) if path.is_dir() else _read_text(path)


def _read_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return times (s) and temperatures of a table; a few rows with an empty cell are left out."""
    try:
        found = read_columns(path, COLUMNS, {}, ("temperature",))
    except TableError as error:
        raise ParameterError(str(error)) from None
    time, values = found.values["time"], found.values["temperature"]
    if not found.rows.size:
        raise ParameterError(f"{path}: has no rows")
    late = np.flatnonzero(np.diff(time) <= 0.0)
    if late.size:
        raise ParameterError(
            f"{path}: column 'time', row {found.rows[late[0] + 1]}: {time[late[0] + 1]} s comes after "
            f"{time[late[0]]} s, must increase"
        )
    return time, values


def _read_bag(path: Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps (s, from the first one on) and temperatures of a bag's topic."""
    from piezo_control.recording.reader import BagError, open_bag

    try:
        bag = open_bag(path)
    except BagError as error:
        raise ParameterError(f"{path}: cannot be read as a bag: {error}") from None
    if bag.damage:
        raise ParameterError(f"{path}: cannot be read as a bag: {bag.damage}")
    if topic not in bag.topics:
        raise ParameterError(f"{path}: topic '{topic}' is missing; it has {bag.content()}")
    try:
        messages = bag.messages(topic, "sensor_msgs/msg/Temperature")
    except BagError as error:
        raise ParameterError(str(error)) from None
    stamps = [m.header.stamp for m in messages]
    nanoseconds = [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps]
    values = [m.temperature for m in messages]
    bad = [n for n, value in enumerate(values) if not math.isfinite(value)]
    if bad or not values:
        what = f"message {bad[0]} is {values[bad[0]]} degC" if bad else "has no messages"
        raise ParameterError(f"{path}: topic '{topic}': {what}, must be finite")
    time = (np.array(nanoseconds) - nanoseconds[0]) * 1e-9
    late = np.flatnonzero(np.diff(time) <= 0.0)
    if late.size:
        raise ParameterError(
            f"{path}: topic '{topic}': message {late[0] + 1} is stamped {time[late[0] + 1]} s after the first, the one "
            f"before it {time[late[0]]} s; must increase"
        )
    return time, np.array(values)
