# SPDX-License-Identifier: Apache-2.0
"""The loop in real time: between a deflection sensor and a voltage amplifier."""
