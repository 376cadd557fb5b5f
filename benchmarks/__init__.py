"""Timings of the library and of what one would use instead."""
