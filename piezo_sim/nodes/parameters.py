# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated cantilever and its temperature as nodes; needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass

from piezo_control.nodes.parameters import BlockParameters, LoopParameters
from piezo_control.parameters import parameter
from piezo_control.safety import HIGHEST_DEGC, LOWEST_DEGC, SafetyParameters
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters


@dataclass(frozen=True)
class CantileverNodeParameters(CantileverParameters, BlockParameters, SafetyParameters):
    """The plant's parameters and the node's own."""

    samples: int = parameter(0, "samples to take, then finish; 0: without end", low=0, high=10**12)
    ambient_temperature_degc: float = parameter(
        22.0, "temperature as long as the topic says nothing", unit="°C", low=LOWEST_DEGC,
        high=HIGHEST_DEGC,
    )  # fmt: skip
    temperature_lockstep: bool = parameter(
        False, "lock-step waits for the temperature of every sample too, asking by `clock`"
    )
    temperature_period: float = parameter(
        1e-3, "grid on which the temperature comes in lock-step", unit="s", low=1e-6, high=10.0
    )
    clock_period: float = parameter(
        1e-2, "how often `clock` is published", unit="s", low=1e-6, high=10.0
    )
    state_period: float = parameter(
        0.1, "how often `state` is published", unit="s", low=5e-3, high=1.0
    )
    reply_timeout: float = parameter(
        2.0, "lock-step: how long an answer may take once the loop has run", unit="s",
        low=0.2, high=3600.0,
    )  # fmt: skip


@dataclass(frozen=True)
class TemperatureNodeParameters(TemperatureParameters, LoopParameters):
    """The profile's parameters and the node's own."""

    ahead: float = parameter(
        0.02, "lock-step: how far the temperatures travel ahead of the clock; at least two of the "
        "cantilever's clock periods", unit="s", low=1e-4, high=10.0,
    )  # fmt: skip
