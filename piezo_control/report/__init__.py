# SPDX-License-Identifier: Apache-2.0
"""Pictures that can be zoomed, and pages of them with tables."""
