# SPDX-License-Identifier: Apache-2.0
"""What runs on a finger, real or simulated: the blocks of the paper's loop."""
