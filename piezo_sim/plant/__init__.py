# SPDX-License-Identifier: Apache-2.0
"""The simulated cantilever: one module for each term of the paper's equation (3)."""
