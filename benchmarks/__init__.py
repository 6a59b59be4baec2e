"""Benchmarks, which are commands and are not installed."""

import trainers  # noqa: F401 - before any other: it refuses other people's packages of our names
