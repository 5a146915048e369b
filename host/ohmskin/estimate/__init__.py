# SPDX-License-Identifier: Apache-2.0
"""From readings to the conductance of every cell: six methods behind one interface.

Takes readings (rows, columns, 4) and what is known of the skin (`base.SkinKnowledge`), gives a
`base.Estimate` with standard deviations. `methods` has them by name.

May import: `ohmskin.circuit` and what is below it. Only `paper` imports CasADi.
"""
