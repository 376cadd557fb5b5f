"""Double precision, strict promotion and two CPU devices for all tests; the groups of problems as fixtures."""

from __future__ import annotations

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_num_cpu_devices", 2)

import hypothesis  # noqa: E402
import pytest  # noqa: E402

# Compilation is part of the first example's time, and the same examples every time make a failure repeatable.
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("repeatable")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "xdist_group(name): tests that share expensive answers run in one process")
