"""The option `--ray` of subcommands."""

import contextlib
import importlib.util
from collections.abc import Iterator
from typing import TYPE_CHECKING

from jaxgrasp.cli.errors import CommandError

if TYPE_CHECKING:
    from jaxgrasp.cluster import Cluster


def check_ray(address: str | None) -> None:
    """Finds out whether Ray is there before any long work.

    Raises:
        CommandError: It is asked for and not installed.
    """
    if address is not None and importlib.util.find_spec("ray") is None:
        raise CommandError("--ray: Ray is not installed; wanted pip install 'jaxgrasp[ray]'")


@contextlib.contextmanager
def cluster_of(address: str, workers: int | None) -> "Iterator[Cluster]":
    """Joins the cluster of `--ray`.

    Args:
        address: As `jaxgrasp.cluster.joined` takes it.
        workers: How many processes; None is one a GPU, and without GPUs one a processor.

    Raises:
        CommandError: There is no such cluster.
    """
    from jaxgrasp.cluster import joined

    with contextlib.ExitStack() as stack:
        try:
            cluster = stack.enter_context(joined(address, workers))
        except (ConnectionError, ImportError) as error:
            raise CommandError(f"--ray {address}: got no cluster ({' '.join(str(error).split())})") from error
        yield cluster
