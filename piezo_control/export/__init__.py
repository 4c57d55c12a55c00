# SPDX-License-Identifier: Apache-2.0
"""From parameter files to firmware: the law of the servo as C99 for a microcontroller."""
