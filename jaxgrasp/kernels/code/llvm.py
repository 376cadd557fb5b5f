"""LLVM for the processor at hand: its target, its options, object code and what becomes of it."""

import contextlib
import ctypes
import functools
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

SETTING = "JAXGRASP_VECTOR_BITS"
# What narrower vectors than the processor's are made without.
_WITHOUT = {128: ",-avx2", 256: ",-avx512f", 512: ""}


class Unavailable(Exception):
    """Why there are no fused kernels here."""


class Machine(NamedTuple):
    """A processor.

    target: LLVM's target machine.
    vector_bytes: size of a vector register.
    estimates: whether it has AVX-512's estimates of reciprocals.
    description: everything that compiled code depends on.
    spoilt: whether all bits of a thread's memory are set before each use, so that tests see what is read unwritten.
    """

    target: Any
    vector_bytes: int
    estimates: bool
    description: str
    spoilt: bool = False


@functools.cache
def machine() -> Machine:
    """The processor at hand, with vectors as long as the environment asks for, else as long as they can be.

    Raises:
        Unavailable: see `with_vectors`.
        ValueError: the environment asks for what is not known.
    """
    asked = os.environ.get(SETTING, "auto")
    if asked not in ("auto", *map(str, _WITHOUT)):
        raise ValueError(f"{SETTING}: got {asked!r}, wanted auto, 128, 256 or 512")
    return with_vectors(None if asked == "auto" else int(asked))


def with_vectors(bits: int | None) -> Machine:
    """The processor at hand, with vectors of so many bits; None for the longest.

    Raises:
        Unavailable: no llvmlite, a processor without fused multiply-add, or without such vectors.
    """
    if os.name != "posix":
        raise Unavailable("this operating system is not supported")
    try:
        import llvmlite
        import llvmlite.binding as llvm
    except ImportError:
        raise Unavailable("llvmlite is not installed; pip install 'jaxgrasp[fast]'") from None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    try:
        name, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features()
        triple = llvm.get_process_triple()
        wide = all(features.get(f, False) for f in ("avx512f", "avx512dq", "avx512vl"))
        if not (features.get("fma", False) or triple.startswith(("aarch64", "arm64"))):
            raise Unavailable(f"the processor {name or 'at hand'} has no fused multiply-add")
        longest = 512 if wide else 256 if features.get("avx2", False) else 128
        bits = bits or longest
        if bits > longest:
            raise Unavailable(f"vectors of {bits} bits are asked for ({SETTING}), the processor has {longest}")
        flags = features.flatten()
        if bits < longest:
            flags += _WITHOUT[bits]
        elif wide:
            flags += ",-prefer-256-bit"
        # The lower level compiles faster, and code here has been put in order already.
        target = llvm.Target.from_triple(triple).create_target_machine(cpu=name, features=flags, opt=1)
    except RuntimeError as error:
        raise Unavailable(f"LLVM does not know the processor: {error}") from None
    return Machine(target, bits // 8, bits == 512, f"{llvmlite.__version__} {triple} {name} {flags}")


def compiled(code: str) -> bytes:
    """Object code of a module.

    Raises:
        RuntimeError: LLVM does not accept it.
    """
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(code)
    module.triple = llvm.get_process_triple()
    with in_given_order():
        return machine().target.emit_object(module)


# LLVM ends the process where it does not know an option; later versions have to be looked at.
_KNOWN_LLVM = range(18, 23)


@contextlib.contextmanager
def in_given_order() -> Iterator[None]:
    """Without LLVM's own order of instructions, which moves results away from where they are used.

    It takes a third of the compile time, and half as many loads and stores again.
    """
    import llvmlite.binding as llvm

    known = llvm.llvm_version_info[0] in _KNOWN_LLVM
    if known:
        llvm.set_option("", "-enable-misched=false")
    try:
        yield
    finally:
        if known:
            llvm.set_option("", "-enable-misched=true")


_engines: list[Any] = []


def loaded(objects: bytes, name: str) -> int:
    """Address of a function in object code, which stays loaded."""
    import llvmlite.binding as llvm

    empty = llvm.parse_assembly("")
    empty.triple = llvm.get_process_triple()
    target = llvm.Target.from_triple(empty.triple).create_target_machine()
    engine = llvm.create_mcjit_compiler(empty, target)
    engine.add_object_file(llvm.ObjectFileRef.from_data(objects))
    engine.finalize_object()
    _engines.append(engine)
    return engine.get_function_address(name)


def capsule(address: int) -> Any:
    """A function pointer as XLA takes it."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)
