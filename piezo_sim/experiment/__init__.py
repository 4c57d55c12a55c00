# SPDX-License-Identifier: Apache-2.0
"""Named experiments, on nodes or on the engine, with their analyses and reports."""
