"""The Protocol of targets: compile a program for a kind of devices, and load the function by which XLA calls it."""

from typing import Protocol

from jaxgrasp.kernels.program.lowering import ScalarProgram


class Target(Protocol):
    """A kind of devices that kernels are compiled for; the modules `cpu.module` and `gpu.module` are two.

    PLATFORM: JAX's name of the devices.
    """

    PLATFORM: str

    def description(self) -> str:
        """Describe everything about the devices at hand that compiled code depends on; part of a kernel's key on disk.

        Raises:
            Unavailable: kernels cannot be compiled for them here, with the reason.
        """
        ...

    def compile_program(self, program: ScalarProgram, name: str) -> bytes:
        """Compile a program to code that can be kept on disk.

        Args:
            program: what to compute for each lane.
            name: of the kernel.

        Raises:
            Unsupported: something in the program cannot run on these devices.
            RuntimeError: LLVM does not accept the code.
        """
        ...

    def load_handler(self, code: bytes, name: str) -> int:
        """Load compiled code for as long as the process lasts; return the address of the handler that XLA calls.

        Args:
            code: what `compile_program` returned, in this process or in an earlier one.
            name: of the kernel.

        Raises:
            RuntimeError: the code cannot be loaded.
        """
        ...
