# SPDX-License-Identifier: Apache-2.0
"""The array types that signatures name."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
