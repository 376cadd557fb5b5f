"""What kernels read from a thread's memory was written there: the check of their code, and whether it finds faults."""

from __future__ import annotations

import re
from functools import partial

import frame_reads
import jax
import jax.numpy as jnp
import kernel_targets
import numpy as np
import pytest
from jax import lax
from llvmlite import binding

from jaxgrasp import kernels
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.cpu import module as cpu
from jaxgrasp.kernels.program.lowering import lower

TARGETS = kernel_targets.targets()


@pytest.fixture(scope="module", autouse=True)
def there_are_kernels():
    assert kernels.usable()


def function(parts):
    """Numbers, integers and flags that live before, in and after two loops, of which the second is that of waiting."""
    start, marks = parts
    known = jnp.sqrt(jnp.abs(start)) + 1

    def first(state):
        total, step = state
        return total * 0.5 + known, step + 1

    total, step = lax.while_loop(lambda s: jnp.any(s[1] < 3), first, (start, jnp.zeros(1, jnp.int32)))
    steep = total[0] > known[0]

    def body(state):
        total, step, odd = state
        return total * 0.5 + jnp.where(steep & marks[0], known, 0), step + 1, odd ^ marks

    def unfinished(state):
        return jnp.any(state[1] < jnp.asarray(7 * jnp.abs(start[0]), jnp.int32))

    total, step, odd = lax.while_loop(unfinished, body, (total, step, marks))
    return {"total": total - known, "step": step, "odd": odd, "steep": steep}


def inputs(dtype: str):
    rng = np.random.default_rng(2)
    return jnp.asarray(rng.normal(size=(90, 3)), dtype), jnp.asarray(rng.random((90, 2)) < 0.5)


def ran(target: llvm.Processor, dtype: str) -> tuple[list[dict[str, np.ndarray]], str]:
    """Three calls, and the kernel's code."""
    run = partial(primitive.fused, shared=(False, False), otherwise=lambda _: None)
    with kernel_targets.compiled_for(target) as texts:
        calls = [run(function, list(inputs(dtype))) for _ in range(3)]
    return [{name: np.asarray(x) for name, x in call.items()} for call in calls], texts[-1]


def by_numpy(dtype: str) -> dict[str, np.ndarray]:
    """The same, each problem by itself."""
    rows = []
    for start, marks in zip(*map(np.asarray, inputs(dtype)), strict=True):
        known, total = np.sqrt(np.abs(start)) + 1, start
        for _ in range(3):
            total = total * 0.5 + known
        steep, step, odd = total[0] > known[0], 3, marks
        while step < int(7 * np.abs(start[0])):
            total, step, odd = total * 0.5 + (known if steep and marks[0] else 0), step + 1, odd ^ marks
        rows.append({"total": total - known, "step": step, "odd": odd, "steep": steep})
    return {name: np.stack([row[name] for row in rows]).reshape(len(rows), -1) for name in rows[0]}


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("target", TARGETS)
def test_spoilt_memory_changes_nothing(target, dtype):
    wanted = by_numpy(dtype)
    calls, text = ran(TARGETS[target], dtype)
    assert frame_reads.unwritten(text) == []
    for call in calls:
        for name, x in call.items():
            np.testing.assert_allclose(x.reshape(len(x), -1), wanted[name], rtol=1e-4 if dtype == "float32" else 1e-12)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_code_for_avx_512_reads_what_it_wrote_and_compiles_anywhere(dtype):
    given = [jax.ShapeDtypeStruct((*x.shape[1:], 1), x.dtype) for x in inputs(dtype)]
    program = lower(jax.make_jaxpr(function)(given), [False, False])
    text = cpu.write_module(program, "here", 64 // jnp.dtype(dtype).itemsize, estimates=True)
    assert frame_reads.unwritten(text) == []
    triple = binding.get_process_triple()
    if not triple.startswith("x86_64"):
        pytest.skip("LLVM here is for other processors")
    module = binding.parse_assembly(text)
    module.triple = triple
    target = binding.Target.from_triple(triple).create_target_machine(cpu="skylake-avx512", features="-prefer-256-bit")
    assert "zmm" in target.emit_assembly(module)


@pytest.fixture(scope="module")
def code():
    return ran(TARGETS["128 bits"], "float64")[1]


def test_what_is_never_stored_is_found(code):
    every = [a for blocks, _ in frame_reads.framed(code).values() for block in blocks.values() for a in block]
    read = {a.array for a in every if not a.stores}
    assert len(read) > 10
    for array in read:
        left_out = {a.line for a in every if a.stores and a.array == array}
        less = "\n".join(line for line in code.splitlines() if line not in left_out)
        assert frame_reads.unwritten(less), array


@pytest.mark.parametrize("table", ["longs", "words", "flags"])
def test_what_is_not_moved_with_a_lane_is_found(code, table):
    count = int(re.search(rf"@{table}\.count = internal constant i64 (\d+)", code)[1])
    assert count > 0
    said = f"@{table}.count = internal constant i64 "
    assert frame_reads.unwritten(code.replace(f"{said}{count}", f"{said}{count - 1}"))


def test_bits_that_no_lane_writes_are_found():
    """As vectors of flags are in memory where they are stored as they are."""
    text = """
define internal void @before(ptr noalias %state, i64 %block, ptr noalias %frame) #0 {
entry:
%near0.known = getelementptr i8, ptr %frame, i64 8192
%near0 = call ptr asm "", "=r,0"(ptr %near0.known)
%v1 = getelementptr i8, ptr %near0, i64 -8192
store <N x i1> splat (i1 true), ptr %v1, align 1
%v2 = getelementptr i8, ptr %near0, i64 -8192
%v3 = load <N x i1>, ptr %v2, align 1
ret void
}
define internal void @take(ptr %state) {
entry:
  %frame = alloca [64 x i8], align 64
  %blocks = udiv i64 %almost, 4
  ret void
}
"""
    assert len(frame_reads.unwritten(text.replace("N", "4"))) == 1
    assert frame_reads.unwritten(text.replace("N", "8")) == []


def test_what_one_branch_alone_writes_is_found():
    text = """
define internal void @before(ptr noalias %state, i64 %block, ptr noalias %frame) #0 {
entry:
%near0.known = getelementptr i8, ptr %frame, i64 8192
%near0 = call ptr asm "", "=r,0"(ptr %near0.known)
%v1 = getelementptr i8, ptr %near0, i64 -8192
br i1 %some, label %inside, label %after
inside:
store <2 x double> zeroinitializer, ptr %v1, align 16
br label %after
after:
%v3 = load <2 x double>, ptr %v1, align 16
ret void
}
define internal void @take(ptr %state) {
entry:
  %frame = alloca [64 x i8], align 64
  %blocks = udiv i64 %almost, 2
  ret void
}
"""
    assert len(frame_reads.unwritten(text)) == 1
    assert frame_reads.unwritten(text.replace("i1 %some, label %inside, label %after", "label %inside")) == []


@pytest.mark.parametrize("target", TARGETS)
def test_a_kernel_that_forgets_to_move_something_answers_wrongly(target, monkeypatch):
    """With spoilt memory, what a lane that waits lacks is seen in its answer: the tests of widths can fail."""
    collect = cpu.VectorCode.collect_lane_state
    monkeypatch.setattr(
        cpu.VectorCode,
        "collect_lane_state",
        lambda *args: {at: kind for at, kind in collect(*args).items() if kind != "b"},
    )
    # Of two lanes none waits.
    dtype = "float32" if TARGETS[target].vector_bytes == 16 else "float64"
    calls, text = ran(TARGETS[target], dtype)
    assert frame_reads.unwritten(text)
    wanted = by_numpy(dtype)
    assert any((call["odd"] != wanted["odd"]).any() for call in calls)
