"""What a demonstrator is."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Expert = Callable[[Any], NDArray[np.float32]]
"""From an environment to the action that a demonstrator would take in its present state."""
