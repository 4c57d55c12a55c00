# SPDX-License-Identifier: Apache-2.0
"""A 20 µm step of the closed loop on the engine, without ROS: settling time and a picture."""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.metrics import step_metrics
from piezo_control.parameters import build, load
from piezo_control.profile import Profile
from piezo_control.shared import shared_folder
from piezo_sim.engine import run
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

controller = shared_folder() / "params" / "feedback_robust.yaml"
made = run(
    CantileverParameters(),
    FeedforwardParameters(),
    build(FeedbackParameters, load(controller, "feedback")),
    TemperatureParameters(base_degc=22.0),
    reference=Profile([0.0], [20e-6]),
    samples=300,
)
found = step_metrics(made.time, made.deflection, 20e-6)
print(f"settled to 5 % after {found.settling_5_reference_s * 1e3:.1f} ms")

plt.plot(made.time * 1e3, made.deflection * 1e6)
plt.xlabel("time [ms]")
plt.ylabel("deflection [µm]")
picture = Path(sys.argv[1] if len(sys.argv) > 1 else "step.png")
plt.savefig(picture)
print(f"wrote {picture}")
