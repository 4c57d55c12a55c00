# SPDX-License-Identifier: Apache-2.0
"""From specifications to a certified controller."""
