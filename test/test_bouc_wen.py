# SPDX-License-Identifier: Apache-2.0
"""Bouc-Wen steps against the differential equation, and the loop the paper shows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from piezo_control.parameters import ParameterError
from piezo_sim.plant.bouc_wen import BoucWen, BoucWenState, TruthParameters, bouc_wen_step

MODEL = BoucWen(7e-7, 2.4e-7, 0.04, -0.01)


@pytest.mark.parametrize("beta, gamma", [(0.04, -0.01), (0.04, 0.01), (0.04, 0.04), (0.04, -0.04)])
def test_steps_solve_the_differential_equation(beta, gamma):
    model = BoucWen(7e-7, 2.4e-7, beta, gamma)
    state = BoucWenState([0.0], [0.0])
    lag = 0.0
    start = 0.0
    for voltage in (40.0, -30.0, 10.0, 9.0, -40.0, 40.0):
        rate = np.sign(voltage - start)

        def law(_, h, rate=rate):
            return 2.4e-7 * rate - beta * h - gamma * rate * np.abs(h)

        distance = abs(voltage - start)
        lag = solve_ivp(law, (0, distance), [lag], rtol=1e-10, atol=1e-18).y[0, -1]
        assert bouc_wen_step(model, state, voltage) == pytest.approx(
            7e-7 * voltage - lag, abs=1e-14
        )
        start = voltage


@given(
    st.lists(st.floats(-40.0, 40.0), min_size=1, max_size=6),
    st.integers(1, 50),
)
def test_how_finely_a_voltage_is_sampled_does_not_matter(voltages, parts):
    coarse, fine = BoucWenState([0.0], [0.0]), BoucWenState([0.0], [0.0])
    for voltage in voltages:
        bouc_wen_step(MODEL, coarse, voltage)
        for step in np.linspace(fine.voltage[0], voltage, parts + 1)[1:]:
            bouc_wen_step(MODEL, fine, float(step))
    assert fine.lag[0] == pytest.approx(coarse.lag[0], abs=1e-17)


def test_default_loop_is_that_of_figure_5():
    p = TruthParameters()
    model = BoucWen(p.slope, p.alpha, p.beta, p.gamma)
    state = BoucWenState([0.0], [0.0])
    voltage = 40.0 * np.sin(2.0 * np.pi * np.arange(1200) / 400)
    deflection = np.array([bouc_wen_step(model, state, v) for v in voltage])[800:]
    stroke = np.ptp(deflection)
    assert np.max(deflection) == pytest.approx(22e-6, rel=0.02)
    assert np.min(deflection) == pytest.approx(-22e-6, rel=0.02)
    assert 0.15 <= (deflection[200] - deflection[0]) / stroke <= 0.20  # at 0 V, down minus up


def test_parameters_without_a_bounded_loop_are_refused():
    with pytest.raises(ParameterError, match="'gamma' is 0.05, must be in"):
        TruthParameters(gamma=0.05)
    with pytest.raises(ParameterError, match="'creep_last' is 0.05 s"):
        TruthParameters(creep_last=0.05)
