"""What the subcommands have in common: how JAX is set, and the disturbances by name."""

import hashlib
import math
import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jaxgrasp.cli.errors import CommandError
from jaxgrasp.storage import cache_folder

if TYPE_CHECKING:
    from jaxgrasp.disturbance import DisturbanceSet

FIGURE_ENDINGS = (".png", ".svg", ".pdf")
BOX = (1.0, 1.0, 1.0, 0.02, 0.02, 0.02)
# What tells processors apart in Linux, on x86 and on ARM: programs for one may end a process on another.
_KINDS = {"vendor_id", "cpu family", "model", "model name", "flags"}
_KINDS |= {"CPU implementer", "CPU variant", "CPU part", "Features"}


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What every subcommand that reads files can be told."""

    read_limit: float = 2.0
    """The most memory that one file that is read may ask for, GiB. What it declares is looked at before it is read."""

    @property
    def budget(self) -> int:
        """The same in bytes.

        Raises:
            CommandError: It is no positive number.
        """
        if not 0.0 < self.read_limit < math.inf:
            raise CommandError(f"--read-limit: got {self.read_limit}; wanted GiB > 0")
        return int(self.read_limit * 2**30)


def configure_jax() -> None:
    """Double precision, programs kept on disk, and as many CPU devices as cores where JAX has not started yet."""
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = _folder_of_programs()
    # JAX gives its configuration the options while it is imported: no stub has them.
    kept = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is not None and kept is None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    try:
        # One program runs on one core; as many devices as cores make a batch run on all of them.
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    except RuntimeError:
        # Whoever calls the command from a program of their own has started JAX already: its devices stay as they are.
        pass


def _folder_of_programs() -> Path | None:
    """Where JAX keeps what it has compiled, for this kind of processor; None where nothing can be kept."""
    try:
        # The first processor's; others of the same machine come after an empty line.
        told = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        processor = "\n".join(line for line in told if line.split("\t")[0].rstrip(" :") in _KINDS)
    except OSError:
        processor = ""
    kind = hashlib.sha256(f"{platform.machine()} {platform.processor()} {processor}".encode()).hexdigest()[:16]
    try:
        return cache_folder("programs", kind)
    except OSError:
        return None


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
        return DisturbanceSet.box(jnp.array(BOX)), "× (1 N, 0.02 N m)"
    return DisturbanceSet.vertices(jnp.asarray(read_wrenches(name))), "times the file's"
