"""Double precision, strict promotion and two CPU devices for all tests; a count of compilations."""

from __future__ import annotations

import os

# What the library does not compile with options of its own takes a third less time so.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=1"

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_num_cpu_devices", 2)

import hypothesis  # noqa: E402
import pytest  # noqa: E402

from jaxgrasp.kernels import primitive  # noqa: E402
from jaxgrasp.robustness.auditing import setting  # noqa: E402

# Compilation is part of the first example's time, and the same examples every time make a failure repeatable.
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture
def compilations():
    """How many programs were compiled so far, as a list that grows."""
    seen = []

    def listen(event: str, duration: float, **_) -> None:
        if event.endswith("backend_compile_duration"):
            seen.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(autouse=True)
def trust(monkeypatch):
    """One test's answer that the audit does not confirm takes no kernels, and no warning, from the others."""
    monkeypatch.setattr(primitive, "_trusted", True)
    monkeypatch.setattr(setting, "_warned", False)
