"""The back of the compiler that all targets have in common: LLVM text, LLVM itself, and XLA's interface."""
