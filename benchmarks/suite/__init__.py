"""The parts of the benchmark; `python -m benchmarks.run` puts them together."""
