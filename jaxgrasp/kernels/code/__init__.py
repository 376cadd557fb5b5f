"""LLVM text for scalar operations, common to all processors."""
