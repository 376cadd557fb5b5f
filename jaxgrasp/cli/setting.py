"""What the subcommands have in common: how JAX is set, and the disturbances by name."""

import hashlib
import os
import platform
import stat
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxgrasp.disturbance import DisturbanceSet

FIGURE_ENDINGS = (".png", ".svg", ".pdf")
BOX = (1.0, 1.0, 1.0, 0.02, 0.02, 0.02)


def configure_jax() -> None:
    """Double precision, programs kept on disk, and as many CPU devices as cores where JAX has not started yet."""
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = _folder_of_programs()
    if folder is not None and jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    try:
        # One program runs on one core; as many devices as cores make a batch run on all of them.
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    except RuntimeError:
        # Whoever calls the command from a program of their own has started JAX already: its devices stay as they are.
        pass


def _folder_of_programs() -> Path | None:
    """Where JAX keeps what it has compiled, for this kind of processor; None where others could write it."""
    try:
        processor = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags"))
    except (OSError, StopIteration):
        processor = platform.processor() or platform.machine()
    kind = hashlib.sha256(processor.encode()).hexdigest()[:16]
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "jaxgrasp" / "programs" / kind
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        own = folder.stat()
    except OSError:
        return None
    trusted = os.name != "posix" or (own.st_uid == os.getuid() and not own.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    return folder if trusted else None


def named_disturbances(name: str) -> "tuple[DisturbanceSet, str]":
    """The set that an option names, or that of a file, and the unit of the margin then.

    Args:
        name: forces, ball, box, or a file of wrenches.

    Raises:
        CandidateError: The file cannot be used.
    """
    import jax.numpy as jnp

    from jaxgrasp.candidates import read_wrenches
    from jaxgrasp.disturbance import DisturbanceSet

    if name == "forces":
        return DisturbanceSet.forces(1.0), "N"
    if name == "ball":
        return DisturbanceSet.ball(force=1.0), "N"
    if name == "box":
        return DisturbanceSet.box(jnp.array(BOX)), "boxes"
    return DisturbanceSet.vertices(jnp.asarray(read_wrenches(name))), "times the file's"
