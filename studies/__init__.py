# SPDX-License-Identifier: Apache-2.0
"""What methods can do, measured on simulated skins: `make chart`, `far` and others.

Not a part of the package: nothing in ``ohmskin`` imports it, and no wheel carries it.
"""
