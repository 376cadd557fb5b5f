"""Processes that were forked from one in which JAX's threads run, and lack these."""

import os

_state = {"used": False, "forked": False}


def check() -> None:
    """Refuse to work in a process that was forked after this library was used: JAX would wait for ever.

    Raises:
        RuntimeError: this is such a process.
    """
    if _state["forked"]:
        raise RuntimeError(
            "jaxgrasp was used before this process was forked, and JAX's threads did not come along; start processes "
            "by multiprocessing.get_context('spawn')"
        )
    _state["used"] = True


def _after_fork() -> None:
    _state["forked"] = _state["used"]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
