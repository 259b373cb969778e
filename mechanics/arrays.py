"""Types of arrays, named by their elements; their shapes are in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]  # shape (height, width, 3)
Texts = NDArray[np.object_]
