"""Clusters of Ray, which is optional: how one is joined, and how JAX is set in its workers."""

import contextlib
import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A cluster that was joined."""

    ray: Any
    """The module of Ray; what is not installed has no types."""
    workers: int
    """The number of processes that work."""
    gpus: bool
    """True if each of them takes a GPU, False if a processor."""

    @property
    def each(self) -> dict[str, int]:
        """Ray's options for the resources of one worker."""
        return {"num_gpus": 1} if self.gpus else {"num_cpus": 1}


@contextlib.contextmanager
def joined(address: str, workers: int | None = None) -> Iterator[Cluster]:
    """Joins a cluster, or starts one on this machine, and leaves it again; one that was joined before stays.

    Args:
        address: That of a cluster, or "local" for one of this machine's own.
        workers: How many processes; None is one a GPU, and without GPUs one a processor.

    Raises:
        ImportError: Ray is not installed.
        ConnectionError: There is no such cluster.
    """
    ray = importlib.import_module("ray")
    mine = not ray.is_initialized()
    if mine:
        own = {"num_cpus": workers} if address == "local" else {"address": address}
        ray.init(include_dashboard=False, log_to_driver=False, logging_level="ERROR", **own)
    try:
        there = ray.cluster_resources()
        gpus = int(there.get("GPU", 0))
        yield Cluster(ray=ray, workers=workers or gpus or int(there.get("CPU", 1)), gpus=bool(gpus))
    finally:
        if mine:
            ray.shutdown()


@dataclass(frozen=True, kw_only=True)
class JaxSettings:
    """Options of JAX in the driver, which workers take over."""

    x64: bool
    cache: str | None

    @classmethod
    def own(cls) -> "JaxSettings":
        """Those of this process."""
        import jax

        # JAX gives its configuration the options while it is imported: no stub has them.
        cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
        return cls(x64=jax.config.jax_enable_x64, cache=cache)  # pyright: ignore[reportAttributeAccessIssue]

    def set(self) -> None:
        """Sets this process likewise."""
        import jax

        jax.config.update("jax_enable_x64", self.x64)
        if self.cache is not None:
            jax.config.update("jax_compilation_cache_dir", self.cache)
