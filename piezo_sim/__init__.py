# SPDX-License-Identifier: Apache-2.0
"""What stands in for a finger, and the experiments on it."""
