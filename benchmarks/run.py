"""Times the library against what one would use instead: `python -m benchmarks.run [--quick] [--output FOLDER]`.

The whole writes results.md and results.json beside this file; `--quick` only prints, unless a folder is given.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="four contacts, few sizes, about two minutes")
    parser.add_argument("--output", type=Path, help="folder for results.md and results.json")
    options = parser.parse_args()
    folder = options.output or (None if options.quick else Path(__file__).parent)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)

    # Two of everything: devices, worker processes, the floor's threads.
    # Imported here, and not above, so that the worker processes, which import this file again, stay without JAX.
    import jax

    jax.config.update("jax_num_cpu_devices", min(2, os.cpu_count() or 1))
    jax.config.update("jax_enable_x64", True)
    from benchmarks.suite import fresh, report, sections
    from benchmarks.suite.clock import say, warn_if_busy
    from benchmarks.suite.workers import Workers

    sizes = sections.QUICK if options.quick else sections.Sizes()
    start = time.perf_counter()
    results = {"machine": report.machine(), "load_average": warn_if_busy(), "quick": options.quick}
    # Before the rest: their peaks are those of processes, but their times want the machine for themselves.
    results["processes"] = fresh.processes(everything=not options.quick)
    with Workers(sections.PROCESSES) as workers:
        results["headline"] = sections.headline(sizes, workers)
        sections.prepare(sizes)
        results["against_peers"] = sections.against_peers(sizes, workers)
    results["scaling"] = sections.scaling(sizes)
    results["worst_cases"] = sections.worst_cases(sizes)
    results["targets"] = report.targets(results)
    text = report.markdown(results)
    say(text)
    if folder is not None:
        (folder / "results.md").write_text(text)
        (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    say(f"Took {time.perf_counter() - start:.0f} s.")


if __name__ == "__main__":
    main()
