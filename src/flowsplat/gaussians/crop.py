"""Keep what lies in a box: a crop of a scene, for the viewer and for exports."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians.model import SceneModel

_MIN_SIDE = 1e-6
"""Of the box round a scene that lies in a plane."""
_TEXT_PRECISION = 1e-3
"""Share of a side by which the text of a box may put it elsewhere. Chosen by eye."""
_MIN_DIGITS, _ALL_DIGITS = 4, 17
"""Of the numbers in such a text: as many as there are without a large offset, and with which every number is exact."""
_NAMES = "x0,y0,z0,x1,y1,z1"


@dataclass(frozen=True)
class CropBox:
    """A box along the axes of the scene, in the coordinates of its cameras.

    Attributes:
        low: x, y, z of the corner with the least of each.
        high: of the corner with the most.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __str__(self) -> str:
        """As ``--crop`` takes it, to a thousandth of its sides."""
        values = np.array([self.low, self.high])
        most = _TEXT_PRECISION * np.tile(values[1] - values[0], 2)
        for digits in range(_MIN_DIGITS, _ALL_DIGITS + 1):
            texts = [f"{value:.{digits}g}" for value in values.ravel().tolist()]
            if (np.abs(np.array(texts, float) - values.ravel()) <= most).all():
                break
        return ",".join(texts)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return which of the points [N, 3] lie in it, [N] bool."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(-1), bool)

    @property
    def edges(self) -> np.ndarray:
        """[12, 2, 3] both ends of each of its edges."""
        corners = np.array(list(itertools.product(*zip(self.low, self.high, strict=True))))
        pairs = itertools.combinations(range(len(corners)), 2)
        return corners[[pair for pair in pairs if np.sum(corners[pair[0]] != corners[pair[1]]) == 1]]


def parse_crop(text: str) -> CropBox:
    """Return the box that is typed as ``x0,y0,z0,x1,y1,z1``.

    Raises:
        InputError: it is none.

    Examples:
        >>> str(parse_crop("-1,-1,0.5,1,1,3"))
        '-1,-1,0.5,1,1,3'
    """
    try:
        values = [float(each) for each in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 6 or not all(math.isfinite(value) for value in values):
        raise InputError(f"--crop {text} cannot be understood: give {_NAMES}, for example --crop=-1,-1,0.5,1,1,3.")
    low, high = tuple(values[:3]), tuple(values[3:])
    if any(least >= most for least, most in zip(low, high, strict=True)):
        raise InputError(f"--crop {text} is empty: x0, y0 and z0 have to be less than x1, y1 and z1.")
    return CropBox(low, high)  # type: ignore[arg-type]


def compute_bounds(model: SceneModel, share: float = 0.0) -> CropBox:
    """Return the least box that holds the centers of all Gaussians, but for a share of them on each side of each axis.

    Args:
        share: 0 to under .5.
    """
    low, high = np.quantile(_centers(model), [share, 1 - share], axis=0)
    thick = np.maximum(high, low + _MIN_SIDE)
    return CropBox(tuple(low.tolist()), tuple(thick.tolist()))


def select_in_box(model: SceneModel, box: CropBox) -> SceneModel:
    """Return the scene with the Gaussians in a box alone, which may be none; what they do not cover stays black.

    What moves stays or goes as a whole Gaussian, by its center at the time at which it is most there.
    """
    rows = torch.from_numpy(np.nonzero(box.holds(_centers(model)))[0]).to(model.gaussians.device)
    return replace(model, gaussians=model.gaussians.select(rows), fill=False)


def crop(model: SceneModel, box: CropBox) -> SceneModel:
    """Return the scene with the Gaussians in a box alone, as ``select_in_box`` does.

    Raises:
        InputError: there are none in it.
    """
    cropped = select_in_box(model, box)
    if not len(cropped.gaussians):
        around = str(compute_bounds(model))
        raise InputError(f"--crop {box} holds nothing of the scene, whose Gaussians lie in {around}.")
    return cropped


def _centers(model: SceneModel) -> np.ndarray:
    """Return [N, 3] float64 in the coordinates of the scene's cameras."""
    return model.similarity.inverse().points(model.gaussians.params["means"].detach().double().cpu().numpy())
