"""LLVM for the processor at hand: its options, object code, and loading of that code."""

import contextlib
import ctypes
import functools
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

SETTING = "JAXGRASP_VECTOR_BITS"
# The features that are switched off for vectors narrower than the processor's, by the bits of a vector.
_WITHOUT = {128: ",-avx2", 256: ",-avx512f", 512: ""}


class Unavailable(Exception):
    """Fused kernels cannot be compiled here; the message says why."""


class Processor(NamedTuple):
    """A processor that kernels are compiled for.

    target_machine: LLVM's target machine.
    vector_bytes: size of a vector register.
    estimates: whether the processor has AVX-512's estimates of reciprocals.
    description: everything that compiled code depends on.
    spoilt: whether all bits of a thread's memory are set before each use, so that tests see reads of unwritten memory.
    """

    target_machine: Any
    vector_bytes: int
    estimates: bool
    description: str
    spoilt: bool = False


@functools.cache
def processor() -> Processor:
    """Describe the processor at hand, with vectors of JAXGRASP_VECTOR_BITS; the longest if that is unset or "auto".

    Raises:
        Unavailable: see `processor_with`.
        ValueError: JAXGRASP_VECTOR_BITS is none of auto, 128, 256 and 512.
    """
    asked = os.environ.get(SETTING, "auto")
    if asked not in ("auto", *map(str, _WITHOUT)):
        raise ValueError(f"{SETTING}: got {asked!r}, wanted auto, 128, 256 or 512")
    return processor_with(None if asked == "auto" else int(asked))


def processor_with(bits: int | None) -> Processor:
    """Describe the processor at hand, with vectors of so many bits; None for the longest.

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
    return Processor(target, bits // 8, bits == 512, f"{llvmlite.__version__} {triple} {name} {flags}")


def compile_module(code: str) -> bytes:
    """Compile a module of LLVM code to object code for the processor at hand.

    Raises:
        RuntimeError: LLVM does not accept it.
    """
    import llvmlite.binding as llvm

    module = llvm.parse_assembly(code)
    module.triple = llvm.get_process_triple()
    with in_given_order():
        return processor().target_machine.emit_object(module)


# The versions that have the option: LLVM ends the process where it does not know one.
_KNOWN_LLVM = range(18, 23)


@contextlib.contextmanager
def in_given_order() -> Iterator[None]:
    """Switch off LLVM's scheduling of machine instructions, which moves results away from where they are used.

    It would take a third of the compile time, and make half as many loads and stores again.
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


def load(objects: bytes, name: str) -> int:
    """Load object code for as long as the process lasts; return the address of one of its functions."""
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
    """Wrap a function's address in the capsule that XLA takes."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)
