"""GrabCut (https://doi.org/10.1145/1015706.1015720) on a part of an image."""

from __future__ import annotations

import cv2
import numpy as np

GRABCUT_ROUNDS = 4
"""Of GrabCut on the frame with the prompt; one is enough to correct an edge. Chosen by eye."""

EDGE_BAND = 0.012
"""Share of the image's long side by which the flow may misplace an edge (docs/method/masks.md)."""


def grab(image: np.ndarray, trimap: np.ndarray, rounds: int) -> np.ndarray:
    """GrabCut from a trimap [H, W] of ``cv2.GC_*``, in a window round what is open; what is left as it was where it fails.

    Returns:
        bool [H, W].
    """
    probable = (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)
    x, y, width, height = cv2.boundingRect((trimap != cv2.GC_BGD).astype(np.uint8))
    # Wide enough that the background's colors are seen.
    pad = max(8, max(width, height) // 4)
    window = (slice(max(y - pad, 0), y + height + pad), slice(max(x - pad, 0), x + width + pad))
    inner = trimap[window].copy()
    background = (inner == cv2.GC_BGD) | (inner == cv2.GC_PR_BGD)
    found = probable.copy()
    if background.any() and not background.all():
        bgr = np.ascontiguousarray(image[window][..., ::-1])
        cv2.setRNGSeed(0)  # Its color models start from random samples.
        cv2.grabCut(bgr, inner, None, np.zeros((1, 65)), np.zeros((1, 65)), rounds, cv2.GC_INIT_WITH_MASK)
        cut = (inner == cv2.GC_FGD) | (inner == cv2.GC_PR_FGD)
        if cut.any():
            found[window] = cut
    return found


def snap_to_edges(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the mask, bool [H, W], with its edge moved to one of the image RGB [H, W, 3] where there is one nearby."""
    margin = max(2, round(EDGE_BAND * max(mask.shape)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    solid = mask.astype(np.uint8)
    trimap = np.full(mask.shape, cv2.GC_BGD, np.uint8)
    trimap[cv2.dilate(solid, kernel) > 0] = cv2.GC_PR_BGD
    trimap[mask] = cv2.GC_PR_FGD
    trimap[cv2.erode(solid, kernel, borderValue=1) > 0] = cv2.GC_FGD
    return grab(image, trimap, 1)


def keep_touched(mask: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return the parts of a mask that ``seeds`` touch, and the seeds themselves; all bool [H, W]."""
    _, labels = cv2.connectedComponents((mask | seeds).astype(np.uint8))
    return np.isin(labels, np.unique(labels[seeds]))
