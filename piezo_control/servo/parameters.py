# SPDX-License-Identifier: Apache-2.0
"""Parameters of the servo; needs no compiler."""

from __future__ import annotations

from dataclasses import dataclass

from piezo_control.parameters import ParameterError, parameter
from piezo_control.safety import (
    LARGEST_DEFLECTION,
    LARGEST_VOLTAGE,
    SafetyParameters,
    VoltageParameters,
)


@dataclass(frozen=True)
class ServoParameters(SafetyParameters):
    """Scales of sensor and amplifier, and when the servo gives up."""

    write: str = parameter(
        "immediately", "when a voltage goes out: as soon as it is computed, or at the next edge, exactly",
        choices=("immediately", "next_edge"),
    )  # fmt: skip
    delay_samples: int = parameter(
        1, "age of a reading when it comes out of sensor and card, as `commission` measures it; the next "
        "edge adds one", low=0, high=1000,
    )  # fmt: skip
    sensor_scale: float = parameter(
        1.0, "deflection per unit of the card's reading, negative for a reversed sensor", unit="m"
    )
    sensor_zero: float = parameter(0.0, "the card's reading at a deflection of zero")
    sensor_low: float = parameter(
        -40e-6, "lowest deflection that the sensor can measure", unit="m",
        low=-LARGEST_DEFLECTION, high=LARGEST_DEFLECTION,
    )  # fmt: skip
    sensor_high: float = parameter(
        40e-6, "highest deflection that the sensor can measure", unit="m",
        low=-LARGEST_DEFLECTION, high=LARGEST_DEFLECTION,
    )  # fmt: skip
    amplifier_gain: float = parameter(
        1.0, "voltage at the finger per unit that the card puts out, negative for reversed wires",
        unit="V",
    )  # fmt: skip
    amplifier_zero: float = parameter(
        0.0,
        "what the card puts out for 0 V at the finger, in its unit, such as the code in the middle",
    )
    card_low: float = parameter(
        0.0, "lowest output of the card, in its unit, such as -10 V or code 0; a finger whose limits lie outside is "
        "refused; as high as 'card_high': not known",
    )  # fmt: skip
    card_high: float = parameter(0.0, "highest output of the card, in its unit")
    age_limit: float = parameter(
        1e-2, "a reading older than this is not acted upon", unit="s", low=1e-6, high=10.0
    )
    frozen_time: float = parameter(
        1e-2, "a sensor is frozen if its reading stays exactly the same for so long …", unit="s",
        low=1e-4, high=10.0,
    )  # fmt: skip
    frozen_voltage: float = parameter(
        4.0,
        "… and the voltage has moved so far meanwhile",
        unit="V",
        low=1e-3,
        high=LARGEST_VOLTAGE,
    )
    model_tolerance: float = parameter(
        30e-6, "how far the deflection may be from what the model says of the voltage; an object in the "
        "way takes up to the whole stroke", unit="m", low=1e-9, high=LARGEST_DEFLECTION,
    )  # fmt: skip
    cycle_amplitude: float = parameter(
        5e-6, "the loop oscillates if its error swings so far, peak to peak, five windows long",
        unit="m", low=1e-9, high=LARGEST_DEFLECTION,
    )  # fmt: skip
    window: float = parameter(
        2e-2,
        "time over which oscillation and late periods are judged",
        unit="s",
        low=1e-4,
        high=10.0,
    )
    missed_limit: int = parameter(
        100, "periods missed one after the other that end in a fault", low=0, high=10**6
    )
    late_share: float = parameter(
        0.2, "share of the periods of five windows that may be late by half a period, or missed",
        low=0.0, high=1.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        for name in ("sensor_scale", "amplifier_gain"):
            if getattr(self, name) == 0.0:
                raise ParameterError(f"'{name}' is 0, must be the scale of a device that is there")
        if not self.sensor_low < self.sensor_high:
            raise ParameterError(
                f"'sensor_low' is {self.sensor_low!r} m, must be below 'sensor_high' ({self.sensor_high!r} m)"
            )
        if self.card_low > self.card_high:
            raise ParameterError(
                f"'card_low' is {self.card_low:g}, must be at most 'card_high' ({self.card_high:g})"
            )

    @property
    def _knows_card(self) -> bool:
        return self.card_low < self.card_high

    def output(self, voltage: float) -> float:
        """Return what the card puts out, in its unit, for a voltage (V) at the finger."""
        return self.amplifier_zero + voltage / self.amplifier_gain

    def check_output(self, limits: VoltageParameters) -> None:
        """Raise ParameterError for limits of the voltage that are outside what the card can put out."""
        out = self.output(limits.voltage_low), self.output(limits.voltage_high)
        if self._knows_card and not self.card_low <= min(out) <= max(out) <= self.card_high:
            raise ParameterError(
                f"the finger gets {self.span(limits)}, must be within 'card_low' and 'card_high': is "
                f"'amplifier_gain' ({self.amplifier_gain:g} V) or 'amplifier_zero' ({self.amplifier_zero:g}) wrong?"
            )

    def span(self, limits: VoltageParameters) -> str:
        """Say within which voltages a finger stays, and what of the card that is: a scale that is wrong shows there."""
        low, high, home = limits.voltage_low, limits.voltage_high, limits.rest
        out = (self.output(voltage) for voltage in (low, high, home))
        ends = (
            f"{self.card_low:g} to {self.card_high:g}" if self._knows_card else "an unknown range"
        )
        return (
            f"{low:g} to {high:g} V, {home:g} V at rest; the card puts out "
            "{:g} to {:g}, {:g} at rest, of {}".format(*out, ends)
        )
