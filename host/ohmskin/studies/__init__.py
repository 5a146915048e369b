# SPDX-License-Identifier: Apache-2.0
"""How well the methods do, on simulated skins whose truth is known: tables, charts, limits."""
