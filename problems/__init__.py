"""Benchmarks that carry their answers: truth, seeded recordings and published reference figures, one file each.

Every benchmark is also a program (``python -m problems.<name>``) that prints its table beside the published one.
"""
