"""The targets that kernels are compiled for, and running on one of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import jax
import pytest

from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.cpu import module as cpu
from jaxgrasp.kernels.store import folder

_NUMBERS = itertools.count()


def targets() -> dict[str, llvm.Processor]:
    """All vectors that the processor has; then some of twice the bits, which LLVM makes of two."""
    found: dict[str, llvm.Processor] = {}
    for bits in (128, 256, 512):
        try:
            found[f"{bits} bits"] = llvm.processor_with(bits)
        except llvm.Unavailable:
            halves = found[f"{bits // 2} bits"]
            name = f"{bits} bits in halves"
            found[name] = halves._replace(vector_bytes=bits // 8, description=f"{halves.description} {name}")
            break
    return found


@contextmanager
def compiled_for(target: llvm.Processor) -> Iterator[list[str]]:
    """What is traced inside runs on kernels for this target, none of them from before, with spoilt memory.

    Gives the LLVM code of those that are compiled.
    """
    texts: list[str] = []
    spoilt = target._replace(spoilt=True, description=f"{target.description} spoilt {next(_NUMBERS)}")
    write = cpu.write_module

    def recorded(*args, **options) -> str:
        texts.append(write(*args, **options))
        return texts[-1]

    jax.clear_caches()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(llvm, "processor", lambda: spoilt)
        patch.setattr(folder, "read", lambda _: None)
        patch.setattr(folder, "keep", lambda *_: None)
        patch.setattr(cpu, "write_module", recorded)
        yield texts
    jax.clear_caches()
