"""HDF5, Parquet and CSV of strangers, read in a process of their own, with limits, that hands over plain arrays.

Their libraries are large and written in C: a file on which one of them ends, or takes more than its share, ends that
process and not this one. See `table_reader` for what it refuses.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from jaxgrasp.storage import FileError, allowance, open_regular, read_archive

# What the libraries take of addresses themselves, and seconds of the processor for each GiB of the budget.
_OWN, _SECONDS = 512 << 20, 3.0
# As for archives: numbers of grasps hardly shrink, and small tables may as they like.
_INFLATION, _SMALL = 100, 128 << 20
_PATIENCE = 60.0
_EXTRA = {"hdf5": "h5py"}


def read_apart(path: Path, kind: str) -> dict[str, np.ndarray]:
    """Reads a table.

    Args:
        path: The file.
        kind: "hdf5", "parquet" or "csv".

    Returns:
        Numbers, truth values and text by name; names of HDF5 have their groups before them (`object/scale`), columns
        of tables that are numbered (`grasp_qpos_0` ...) are one array.

    Raises:
        FileError: It is damaged, too large, names other files, or its library is not installed.
    """
    wanted = f"an intact {kind.upper() if kind != 'parquet' else 'Parquet'} file"
    with open_regular(path, wanted) as stream:
        size = stream.seek(0, os.SEEK_END)
    budget = min(allowance(), max(_SMALL, _INFLATION * size))
    with tempfile.TemporaryDirectory(prefix="jaxgrasp-") as folder:
        result = Path(folder, "table.npz")
        # Twice: once as read, once as written.
        limits = [str(budget), str(2 * budget + _OWN), str(max(2, round(_SECONDS * allowance() / 2**30)))]
        command = [sys.executable, "-P", str(Path(__file__).with_name("table_reader.py"))]
        command += [kind, str(path.absolute()), str(result), *limits]
        # No filters of HDF5 from elsewhere, and no threads, each of which would take addresses of its own.
        environment = os.environ | {"HDF5_PLUGIN_PATH": "::", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        quiet = subprocess.DEVNULL
        try:
            child = subprocess.run(
                command,
                cwd=folder,
                env=environment,
                timeout=_PATIENCE,
                stdin=quiet,
                stdout=subprocess.PIPE,
                stderr=quiet,
            )
        except subprocess.TimeoutExpired as error:
            raise FileError(path, None, f"a file that takes more than {_PATIENCE:g} s to read", wanted) from error
        if child.returncode == 0:
            return read_archive(result)
    said = child.stdout.decode("utf-8", "replace").strip()
    if child.returncode == 3:
        raise FileError(path, None, f"a file that {_EXTRA[kind]} reads", "pip install 'jaxgrasp[files]'")
    if child.returncode != 1 or not said:
        said = f"a file on which its library ends (code {child.returncode}), or that takes too much"
        raise FileError(path, None, said, f"{wanted}, or more room (see --read-limit)")
    raise FileError(path, None, said, wanted)
