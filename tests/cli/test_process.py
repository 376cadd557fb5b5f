"""The command as a process: signals, standard streams and what it finds when it starts."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main, streams

COMMAND = [sys.executable, "-m", "jaxgrasp.cli"]
# Shows what a command's process is doing, and lets the test send its signal then.
SHOWING = """
import sys, time
from jaxgrasp.cli import program, report
tick = report.Clock.tick
report.Clock.tick = lambda self, done: (tick(self, done), print(done, flush=True), time.sleep(0.05))
from jaxgrasp.ranking import tiles
tiles.TILE["cpu"] = 64
program()
"""


# What is unfinished takes long to remove, and the command fails meanwhile, since it is gone.
FAILING = """
import sys, threading, time
from jaxgrasp import storage
from jaxgrasp.cli import program, start
from jaxgrasp.cli.errors import CommandError
removed = threading.Event()
storage.discard_unfinished = lambda: (removed.set(), time.sleep(1.0))
def fail(arguments):
    print("begun", flush=True)
    removed.wait()
    raise CommandError("--output: cannot be written")
start._answer = fail
program()
"""


def begun(*arguments: str, program: str | None = None, **options) -> subprocess.Popen:
    command = COMMAND if program is None else [sys.executable, "-c", program]
    return subprocess.Popen(
        [*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


@pytest.fixture
def grasps(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    found = sample_grasps(2000)
    np.savez(
        "grasps.npz",
        positions=found.positions,
        outward_normals=found.normals,
        friction=found.friction,
        max_force=found.max_force,
    )
    return tmp_path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["rank", "synthesize", "compare"])
def test_a_signal_before_anything_is_finished_ends_it_at_once(grasps, command, number):
    options = ["grasps.npz"] if command == "compare" else []
    process = begun(command, *options)
    # While JAX is imported; Python itself starts before.
    time.sleep(0.5)
    sent = time.monotonic()
    process.send_signal(number)
    printed, complaint = process.communicate(timeout=60)
    word = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}[number]
    assert (process.returncode, printed) == (128 + number, "")
    assert complaint == f"jaxgrasp: {word}, nothing was written\n"
    assert time.monotonic() - sent < 10.0
    assert os.listdir(grasps) == ["grasps.npz"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_fails_while_a_signal_ends_the_command_is_not_told(number):
    process = begun(program=FAILING)
    assert process.stdout.readline() == "begun\n"
    process.send_signal(number)
    complaint = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + number
    assert complaint.endswith("nothing was written\n") and complaint.count("\n") == 1


def test_what_is_finished_is_kept_after_sigterm(grasps):
    pyarrow = pytest.importorskip("pyarrow.parquet")
    process = begun("rank", "grasps.npz", "--figure", "None", program=SHOWING)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    _, complaint = process.communicate(timeout=120)
    assert process.returncode == 143
    rows = pyarrow.read_table("ranking.parquet").num_rows
    assert 0 < rows < 2000 and complaint == f"jaxgrasp: terminated: ranked {rows:,} of 2,000\n"


def test_the_second_signal_does_not_wait(grasps):
    process = begun("rank", "grasps.npz", "--figure", "None", program=SHOWING.replace("0.05", "20"))
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert process.poll() is None, "it may finish its tile"
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=15)
    assert (process.returncode, complaint) == (130, "jaxgrasp: interrupted, nothing was written\n")


def test_a_background_job_passes_ctrl_c_over(grasps):
    # A child begins with what its parent ignores.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = begun("--help")
    finally:
        signal.signal(signal.SIGINT, before)
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and "usage" in printed


def test_main_leaves_signals_as_they_were(capsys):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit):
        main(["--help"])
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert signal.set_wakeup_fd(-1) == -1


def shell(line: str, **variables: str | None) -> subprocess.CompletedProcess:
    environment = {**os.environ, **{k: v for k, v in variables.items() if v is not None}}
    for name in (k for k, v in variables.items() if v is None):
        del environment[name]
    return subprocess.run(
        ["bash", "-c", line.replace("jaxgrasp", " ".join(COMMAND))], capture_output=True, text=True, env=environment
    )


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("exec jaxgrasp --help >&-", 0, ""),
        ("exec jaxgrasp --help <&- >&- 2>&-", 0, ""),
        ("exec jaxgrasp --help > /dev/full", 2, "standard output: cannot be written (No space left on device)"),
        ("jaxgrasp --help | head -n 1; exit ${PIPESTATUS[0]}", 0, ""),
        ("jaxgrasp rank --help | true; exit ${PIPESTATUS[0]}", 0, ""),
    ],
)
def test_standard_output_that_is_not_there(line, code, words):
    done = shell(line)
    assert done.returncode == code
    assert done.stderr == (f"jaxgrasp: {words}\n" if words else "")


def test_a_reader_who_has_gone_is_no_error():
    program = (
        "import time; from rich.console import Console; from jaxgrasp.cli.streams import printing\n"
        "time.sleep(0.5)\n"
        "with printing(): Console().print('a line' + chr(10) + 'another')\n"
        "raise SystemExit(7)"
    )
    line = f'{sys.executable} -c "$PROGRAM" | true; exit ${{PIPESTATUS[0]}}'
    done = shell(line, PROGRAM=program)
    assert (done.returncode, done.stderr) == (7, "")


def test_any_encoding_will_do(grasps):
    name = "grö\udcffsse\n猫.npz"
    os.rename("grasps.npz", name)
    command = [*COMMAND, "rank", name, "--figure", "None", "--output", "table.csv", "--top", "2"]
    done = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"N\\xb2" in done.stdout and Path("table.csv").exists()


def test_messages_are_one_line_whatever_is_in_them(capsys):
    streams.one_line("a\n b\x1b[31m\udcff")
    assert capsys.readouterr().err == "jaxgrasp: a b\\x1b[31m\\udcff\n"


def test_a_cache_that_cannot_be_written_is_told_in_one_line(grasps):
    pytest.importorskip("llvmlite")
    (grasps / "no_folder").write_text("")
    line = "exec jaxgrasp rank grasps.npz --figure None --top 0"
    done = shell(line, XDG_CACHE_HOME=str(grasps / "no_folder"))
    assert done.returncode == 0
    assert done.stderr.count("\n") == 1 and "kernels cannot be kept on disk" in done.stderr


def test_the_package_is_light_until_it_is_used():
    program = (
        "import sys, jaxgrasp.cli, jaxgrasp as jg\n"
        "assert not {'jax', 'numpy', 'tyro'} & set(sys.modules)\n"
        "assert 'Contacts' in dir(jg) and jg.solvers.solve_qp and jg.Contacts\n"
        "assert not hasattr(jg, 'nothing')\n"
        "from jaxgrasp import *\n"
        "assert largest_disturbance is jg.largest_disturbance"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
