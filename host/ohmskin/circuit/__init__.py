# SPDX-License-Identifier: Apache-2.0
"""From resistances to readings: `skin` is a network of resistors, `small` solves its matrices."""
