# SPDX-License-Identifier: Apache-2.0
"""Names for the arrays that all rooms pass around. Their docstrings say shapes and units."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
