"""Static 3D Gaussians out of files of any program: ``.ply`` of 3D Gaussian Splatting, ``.splat`` and ``.spz``.

What the file says is looked at before anything of it is read, so that a few bytes cannot ask for gigabytes.
"""

from flowsplat.output.splat_files.reading import SUFFIXES, is_splat_file, read_splats, report_left_out
from flowsplat.output.splat_files.splats import Splats

__all__ = ["SUFFIXES", "Splats", "is_splat_file", "read_splats", "report_left_out"]
