# SPDX-License-Identifier: Apache-2.0
"""``python -m ohmskin``: the command line."""

from ohmskin.cli.main import main

main()
