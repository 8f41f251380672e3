"""Engines: where the pairs of a cohort run, each an executor as of `concurrent.futures`."""
