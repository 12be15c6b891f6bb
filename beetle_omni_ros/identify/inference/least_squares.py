"""Normal equations."""

import numpy as np


def solved(h: np.ndarray, right: np.ndarray, ridge: float = 1e-9) -> np.ndarray:
    """
    Solution of normal equations ``h x = right`` with coordinates of different scale.

    ``ridge`` is a relative increase of each diagonal element.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(h), 1e-12))
    inner = h * scale[:, None] * scale + ridge * np.eye(len(h))
    return (scale * np.linalg.solve(inner, (scale * right.T).T).T).T
