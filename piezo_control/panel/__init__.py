# SPDX-License-Identifier: Apache-2.0
"""The page of a finger or two in a browser: what was measured of late, figures, controls; needs Bokeh, no ROS."""
