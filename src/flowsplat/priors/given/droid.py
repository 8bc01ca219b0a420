"""DROID-SLAM's trajectory as Shape of Motion's preprocessing saves it: ``droid_recon/<clip>.npy``.

https://github.com/vye16/shape-of-motion/blob/main/preproc/recon_with_depth.py: a pickled dictionary with ``traj_c2w``
[N, 4, 4], ``intrinsics`` [4] (fx, fy, cx, cy) and ``img_shape`` (h, w), both at an eighth of the cropped image.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file
from flowsplat.geometry import Camera
from flowsplat.priors.given.fitting import SLAM_MULTIPLE, require_frames, slam_size
from flowsplat.scenes import Scene

MAKER = "DROID-SLAM"


def read_droid(path: Path, scene: Scene, allow_pickle: bool) -> list[Camera]:
    """Return one camera a frame, at the size that the whole image had for DROID-SLAM.

    Raises:
        InputError: pickles are not allowed, or it is damaged or not of this clip.
    """
    ordinary_file(path)
    if not allow_pickle:
        raise InputError(
            f"{path} is a pickle, and reading one runs whatever code is in it: "
            "if you made it or trust who did, add --given.allow-pickle."
        )
    try:
        content = np.load(path, allow_pickle=True).item()
        poses = np.asarray(content["traj_c2w"], np.float64).reshape(-1, 4, 4)
        fx, fy, cx, cy = (float(value) for value in content["intrinsics"])
        rows, columns = (int(value) for value in content["img_shape"][:2])
        viewmats = np.linalg.inv(poses)
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, ImportError, IndexError) as error:
        raise InputError(f"{path} does not hold traj_c2w, intrinsics and img_shape of DROID-SLAM: {error}.") from error
    except (pickle.UnpicklingError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path} is damaged: {error}.") from error
    require_frames(path, len(viewmats), scene, "cameras")
    width, height = slam_size(path, columns * SLAM_MULTIPLE, rows * SLAM_MULTIPLE, scene)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1 / SLAM_MULTIPLE]]) * SLAM_MULTIPLE
    return [Camera(viewmat, K, width, height) for viewmat in viewmats]
