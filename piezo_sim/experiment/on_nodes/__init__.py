# SPDX-License-Identifier: Apache-2.0
"""Experiments over topics: node processes, conducted through their services."""
