# SPDX-License-Identifier: Apache-2.0
"""Drivers of cards, each a shared library (:mod:`piezo_control.servo.driver`)."""
