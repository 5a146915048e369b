# SPDX-License-Identifier: Apache-2.0
"""From bytes to scans: everything between a board and a program that reads it.

    bytes -> frames (`framing`) -> messages (`messages`) -> scans and answers (`session`, `device`)

Takes a port (`serial_port`, or any `Link`), gives `Scan`, `Hello` and other messages. `protocol`
is the only source of the link's numbers: it reads ``protocol/frames.toml``. `codes` makes ratios of
ADC codes. `clock` says when readings were taken, and puts boards on the host's clock.

May import: `ohmskin.errors`, `files`, `arrays`. `framing` and `messages` never import ``serial``.
"""
