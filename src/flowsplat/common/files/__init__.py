"""Files, in and out.

What is written is whole or not there (``writing``). What is read comes from anywhere: ``opening`` refuses what is no ordinary file
or larger than its kind can need, and one reader for each kind understands it (``json_file``, ``arrays``, ``zip_file``). Names that
come out of files or from a browser become names of files through ``names`` alone.
Who writes into a folder that others may want has a
``lease`` of it; who does a piece of a list of work has a claim on it (``Claims``).
"""

from flowsplat.common.files.arrays import read_npy, read_npz
from flowsplat.common.files.json_file import check_json, read_json, read_json_lines
from flowsplat.common.files.lease import Claims, lease
from flowsplat.common.files.names import plain_name
from flowsplat.common.files.opening import ordinary_file, read_bytes, read_text
from flowsplat.common.files.rows import read_rows
from flowsplat.common.files.writing import (
    as_written,
    atomic_path,
    hash_files,
    make_folder,
    remove_partials,
    require_keys,
    write_bytes,
    write_json,
    write_npz,
    write_text,
)
from flowsplat.common.files.zip_file import list_zip, read_zip

__all__ = [
    "Claims",
    "as_written",
    "atomic_path",
    "check_json",
    "hash_files",
    "lease",
    "list_zip",
    "make_folder",
    "ordinary_file",
    "plain_name",
    "read_bytes",
    "read_json",
    "read_json_lines",
    "read_npy",
    "read_npz",
    "read_rows",
    "read_text",
    "read_zip",
    "remove_partials",
    "require_keys",
    "write_bytes",
    "write_json",
    "write_npz",
    "write_text",
]
