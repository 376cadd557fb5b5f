"""The GPU target: a program as code for NVIDIA's GPUs, one lane of the batch per thread.

LLVM writes PTX, which is kept on disk; the driver's assembler makes a device's own code of it.
"""

import functools
import math
from typing import NamedTuple

import jax

from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.code.llvm import Unavailable
from jaxgrasp.kernels.gpu import driver, handler
from jaxgrasp.kernels.gpu.threads import ThreadCode
from jaxgrasp.kernels.program.expressions import Unsupported, Value, kind_of
from jaxgrasp.kernels.program.lowering import ScalarProgram
from jaxgrasp.kernels.program.schedule import schedule

# JAX's name of the devices.
PLATFORM: str = "CUDA"
TRIPLE = "nvptx64-nvidia-cuda"
# Threads of a block: two warps, so that a small batch is spread over many processors.
THREADS = 64
# Newer devices run code for this one, which all versions of LLVM here know.
_NEWEST = 90
# Pointers that a kernel takes; 4,096 bytes are the most.
_MOST_POINTERS = 500


class Devices(NamedTuple):
    """The GPUs of this process.

    numbers: the driver's numbers of the devices.
    capability: compute capability of the oldest device, 80 for sm_80.
    description: everything that compiled code depends on.
    """

    numbers: list[int]
    capability: int
    description: str


@functools.cache
def devices() -> Devices:
    """Find the GPUs at hand.

    Raises:
        Unavailable: there are none of NVIDIA's, no driver that can be used, or no llvmlite.
    """
    try:
        found = jax.local_devices(backend="cuda")
        known = [int(device.compute_capability.replace(".", "")) for device in found]
    except (RuntimeError, AttributeError) as error:
        raise Unavailable(f"JAX knows no GPU of NVIDIA's: {error}") from None
    driver.load_driver()
    version, capability = llvm.processor().description.split()[0], min(_NEWEST, *known)
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
    """Describe everything about the GPUs at hand that compiled code depends on.

    Raises:
        Unavailable: see `devices`.
    """
    return devices().description


def write_module(program: ScalarProgram, name: str) -> str:
    """Write LLVM code of a kernel of pointers to arguments and results, all batch-first, and the number of rows.

    Args:
        program: what to compute.
        name: of the kernel.

    Raises:
        Unsupported: the program has types or functions that are not known on GPUs, or too many arguments.
    """
    for _, dtype in program.inputs + program.out_avals:
        if dtype.kind in "iu" and dtype.itemsize != 4:
            raise Unsupported(f"arguments or results of type {dtype}")
    if len(program.inputs) + len(program.outputs) > _MOST_POINTERS:
        raise Unsupported("too many arguments and results")
    code, own = ThreadCode(program), []
    for number, ((shape, dtype), shared) in enumerate(zip(program.inputs, program.shared, strict=True)):
        base = f"%argument{number}"
        own.append(base if shared else _row_pointer(code, base, math.prod(shape), kind_of(dtype)))
    places, results = [], []
    for number, (out, (_, dtype)) in enumerate(zip(program.outputs, program.out_avals, strict=True)):
        start = _row_pointer(code, f"%result{number}", out.size, kind_of(dtype))
        places += [(start, entry, kind_of(dtype)) for entry in range(out.size)]
        results += list(out.flat)

    def store(number: int, name: str) -> None:
        (start, entry, kind), value = places[number], results[number]
        if type(value) is not Value:
            name = code.constant(value, kind)
        name = code.emit(f"zext i1 {name} to i8") if kind == "b" else name
        place = code.emit(f"getelementptr {_unit(code, kind)}, ptr addrspace(1) {start}, i64 {entry}")
        code.do(f"store {_unit(code, kind)} {name}, ptr addrspace(1) {place}")

    code.write(schedule(program), own, store)
    parameters = [f"ptr addrspace(1) noalias readonly %argument{i}" for i in range(len(program.inputs))]
    parameters += [f"ptr addrspace(1) noalias %result{i}" for i in range(len(program.outputs))]
    text = _KERNEL.replace("@NAME@", f"@{name}").replace("@PARAMETERS@", ", ".join(parameters))
    text = text.replace("@DECLARATIONS@", "\n".join(sorted(code.declarations)))
    return text.replace("@BODY@", "\n".join(code.lines))


def _unit(code: ThreadCode, kind: str) -> str:
    return "i8" if kind == "b" else code.types[kind]


def _row_pointer(code: ThreadCode, base: str, count: int, kind: str) -> str:
    """Write the pointer to this thread's row."""
    before = code.emit(f"mul i64 %row, {count}")
    return code.emit(f"getelementptr {_unit(code, kind)}, ptr addrspace(1) {base}, i64 {before}")


def write_ptx(code: str, capability: int) -> str:
    """Compile a module to PTX.

    Args:
        code: LLVM code.
        capability: compute capability of the oldest device that shall run it, 80 for sm_80.

    Raises:
        RuntimeError: LLVM does not accept it, or was built without GPUs.
    """
    from llvmlite import binding

    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    target = binding.Target.from_triple(TRIPLE).create_target_machine(cpu=f"sm_{capability}", opt=2)
    # LLVM's own order takes a sixth more of a thread's memory in float64.
    with llvm.in_given_order():
        return target.emit_assembly(binding.parse_assembly(code))


def compile_program(program: ScalarProgram, name: str) -> bytes:
    """Compile a program to PTX for all devices at hand, with one kernel `name`.

    Raises:
        Unsupported: see `write_module`.
        RuntimeError: LLVM does not accept it.
    """
    return write_ptx(write_module(program, name), devices().capability).encode()


def load_handler(code: bytes, name: str) -> int:
    """Load a kernel; return the address of the function by which XLA launches it.

    Args:
        code: PTX.
        name: of the kernel, and of the function.

    Raises:
        RuntimeError: the driver does not accept it.
    """
    kernel = driver.load_kernel(code, name, devices().numbers)
    text = handler.write_module(name, kernel=kernel, launch=driver.launch_address(), threads=THREADS)
    return llvm.load(llvm.compile_module(text), name)
