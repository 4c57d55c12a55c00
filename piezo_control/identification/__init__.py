# SPDX-License-Identifier: Apache-2.0
"""From a measurement of an actuator to its parameters."""
