# SPDX-License-Identifier: Apache-2.0
"""Numbers by which more than one examiner tells a fault from what a sound skin shows."""

from typing import Final

# How many standard deviations a value must be off before it is a finding. The more values are
# looked at, the further off one of them is by chance. The shares are those of normal errors.
# [deviations] One value, or one of some ten such as lines, is a finding beyond this. Chosen: by
# chance, one of 2,000 is that far off.
FEW_STDS: Final = 3.5
# [deviations] One of hundreds of values, such as cells or segments, is a finding beyond this.
# Chosen: by chance, one of 1.7 million is that far off.
MANY_STDS: Final = 5.0
# [deviations] One of all 1,024 readings of the largest scan is a finding beyond this. Chosen: by
# chance, one of 500 million is that far off.
ALL_STDS: Final = 6.0

# [LSB] Offset of a sound converter, and as much gain error at full scale (ATmega328P data sheet,
# ADC characteristics: 2 LSB each).
ADC_ERROR_LSB: Final = 2.0
# [LSB] Rounding to a code is off by up to half of one, by definition. Hum of a smaller amplitude is
# not reported, and scatter is taken to be at least this, since rounding may hide it.
ROUNDING_LSB: Final = 0.5
# [LSB] A board with more noise in its usual cell is noisy, and so is a single line or cell with
# more. Chosen: nearly twice that of a sound one.
NOISY_LSB: Final = 0.8
# [LSB] Readings of pressed cells and of plates that change by more with a longer settle time have
# not settled. Chosen: they show some 400, and 1 % of that is no fault.
PRESSED_LSB: Final = 4.0

# [1] A cell with less than this share of the conductance that it should have does not conduct.
# Chosen: cells at rest scatter by 10 %, a dead one has none.
DEAD_SHARE: Final = 0.3
# [1] Wires that differ by less than this share from what they should be are no fault. Chosen:
# estimators expect changes of LAYER_STD anyway.
CHANGED_SHARE: Final = 0.25
# [ohm] Standard deviation of a lead that nobody has told: the doctor takes it for the switch of a
# multiplexer alone. Chosen: a CD74HC4067's switch has 70 ohm typically and 180 at most (data sheet,
# at 4.5 V). A margin of yarn has more, and must be told.
SWITCH_LEAD_STD_OHM: Final = 40.0
# [log] Wires with a larger deviation are not known. Chosen: it is not far below CHANGED_SHARE.
KNOWN_STD: Final = 0.15
