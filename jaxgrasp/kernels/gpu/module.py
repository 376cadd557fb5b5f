"""A program as code for NVIDIA's GPUs, one problem per thread.

LLVM writes PTX, which is kept on disk; the driver's assembler makes a device's own code of it.
"""

import functools
import math
from typing import NamedTuple

import jax

from jaxgrasp.kernels.code import llvm as machine
from jaxgrasp.kernels.code.llvm import Unavailable
from jaxgrasp.kernels.gpu import driver as cuda
from jaxgrasp.kernels.gpu import handler as launcher
from jaxgrasp.kernels.gpu.threads import ThreadCode
from jaxgrasp.kernels.program.expressions import Unsupported, Value, kind_of
from jaxgrasp.kernels.program.lowering import Program
from jaxgrasp.kernels.program.schedule import scheduled

# As XLA calls the devices.
PLATFORM = "CUDA"
TRIPLE = "nvptx64-nvidia-cuda"
# Threads of a block: two warps, so that few problems are spread over many processors.
THREADS = 64
# Newer devices run code for this one, which all versions of LLVM here know.
_NEWEST = 90
# Pointers that a kernel takes; 4,096 bytes are the most.
_MOST_POINTERS = 500


class Devices(NamedTuple):
    """The GPUs of this process.

    numbers: the driver's.
    capability: of the oldest, as in sm_80.
    description: everything that compiled code depends on.
    """

    numbers: list[int]
    capability: int
    description: str


@functools.cache
def devices() -> Devices:
    """The GPUs at hand.

    Raises:
        Unavailable: none of NVIDIA's, no driver that can be used, or no llvmlite.
    """
    try:
        found = jax.local_devices(backend="cuda")
        known = [int(device.compute_capability.replace(".", "")) for device in found]
    except (RuntimeError, AttributeError) as error:
        raise Unavailable(f"JAX knows no GPU of NVIDIA's: {error}") from None
    cuda.driver()
    version, capability = machine.machine().description.split()[0], min(_NEWEST, *known)
    return Devices([d.local_hardware_id for d in found], capability, f"{version} {TRIPLE} sm_{capability}")


_KERNEL = """target triple = "nvptx64-nvidia-cuda"
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
@DECLARATIONS@

define ptx_kernel void @NAME@(@PARAMETERS@, i64 %rows) {
entry:
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
  %thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block.wide = zext i32 %block to i64
  %threads.wide = zext i32 %threads to i64
  %thread.wide = zext i32 %thread to i64
  %before = mul i64 %block.wide, %threads.wide
  %row = add i64 %before, %thread.wide
  %inside = icmp ult i64 %row, %rows
  br i1 %inside, label %work, label %done
work:
@BODY@
  br label %done
done:
  ret void
}
"""


def description() -> str:
    """Everything about the GPUs at hand that compiled code depends on.

    Raises:
        Unavailable: there are no fused kernels for them.
    """
    return devices().description


def module(program: Program, name: str) -> str:
    """LLVM code of the kernel `name`: of pointers to arguments and results, all batch-first, and the number of rows.

    Args:
        program: what to compute.
        name: of the kernel.

    Raises:
        Unsupported: types or functions that are not known on GPUs, or too many arguments.
    """
    for _, dtype in program.inputs + program.out_avals:
        if dtype.kind in "iu" and dtype.itemsize != 4:
            raise Unsupported(f"arguments or results of type {dtype}")
    if len(program.inputs) + len(program.outputs) > _MOST_POINTERS:
        raise Unsupported("too many arguments and results")
    code = ThreadCode(program.builder.dtype)
    code.block = "work"
    for number, ((shape, dtype), shared) in enumerate(zip(program.inputs, program.shared, strict=True)):
        base = f"%argument{number}"
        code.own.append(base if shared else _row(code, base, math.prod(shape), kind_of(dtype)))
    places, results = [], []
    for number, (out, (_, dtype)) in enumerate(zip(program.outputs, program.out_avals, strict=True)):
        start = _row(code, f"%result{number}", out.size, kind_of(dtype))
        places += [(start, entry, kind_of(dtype)) for entry in range(out.size)]
        results += list(out.flat)

    def store(number: int, name: str) -> None:
        (start, entry, kind), value = places[number], results[number]
        if type(value) is not Value:
            name = code.constant(value, kind)
        name = code.emit(f"zext i1 {name} to i8") if kind == "b" else name
        place = code.emit(f"getelementptr {_unit(code, kind)}, ptr addrspace(1) {start}, i64 {entry}")
        code.do(f"store {_unit(code, kind)} {name}, ptr addrspace(1) {place}")

    code.write(scheduled(program), store)
    parameters = [f"ptr addrspace(1) noalias readonly %argument{i}" for i in range(len(program.inputs))]
    parameters += [f"ptr addrspace(1) noalias %result{i}" for i in range(len(program.outputs))]
    text = _KERNEL.replace("@NAME@", f"@{name}").replace("@PARAMETERS@", ", ".join(parameters))
    text = text.replace("@DECLARATIONS@", "\n".join(sorted(code.declarations)))
    return text.replace("@BODY@", "\n".join(code.lines))


def _unit(code: ThreadCode, kind: str) -> str:
    return "i8" if kind == "b" else code.types[kind]


def _row(code: ThreadCode, base: str, count: int, kind: str) -> str:
    """Where this thread's row begins."""
    before = code.emit(f"mul i64 %row, {count}")
    return code.emit(f"getelementptr {_unit(code, kind)}, ptr addrspace(1) {base}, i64 {before}")


def ptx(code: str, capability: int) -> str:
    """PTX of a module.

    Args:
        code: LLVM code.
        capability: of the oldest device that shall run it, as in sm_80.

    Raises:
        RuntimeError: LLVM does not accept it, or was built without GPUs.
    """
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(TRIPLE).create_target_machine(cpu=f"sm_{capability}", opt=2)
    # LLVM's own order takes a sixth more of a thread's memory in float64.
    with machine.in_given_order():
        return target.emit_assembly(llvm.parse_assembly(code))


def compiled(program: Program, name: str) -> bytes:
    """PTX of a program for all devices at hand, one kernel `name`.

    Raises:
        Unsupported: something in it is not known on GPUs.
        RuntimeError: LLVM does not accept it.
    """
    return ptx(module(program, name), devices().capability).encode()


def handler(code: bytes, name: str) -> int:
    """Address of the function by which XLA launches a kernel.

    Args:
        code: PTX.
        name: of the kernel, and of the function.

    Raises:
        RuntimeError: the driver does not accept it.
    """
    kernel = cuda.kernel(code, name, devices().numbers)
    text = launcher.module(name, kernel=kernel, launch=cuda.launch_address(), threads=THREADS)
    return machine.loaded(machine.compiled(text), name)
