# SPDX-License-Identifier: Apache-2.0
"""Forces of a skin in ROS 2: `node` has the node, `messages` what it publishes."""
