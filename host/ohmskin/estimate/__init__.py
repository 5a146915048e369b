# SPDX-License-Identifier: Apache-2.0
"""From readings to the conductance of every cell: the methods behind one interface.

Takes readings (rows, columns, 4) and what is known of the skin (`knowledge.SkinKnowledge`), gives a
`base.Estimate` with standard deviations, and the level that a force is read from. `methods` makes
an estimator by its name. `port_faults` says which frames cannot be trusted, `staying_faults` which
lines are damaged.

May import: `ohmskin.circuit` and what is below it. Only `paper` imports CasADi.
"""
