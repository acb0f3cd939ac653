"""Experiments around igsr: studies, benchmarks, synthetic captures, training of the denoiser.

Not part of the wheel. ``python -m igsr_lab`` lists the commands. The lab imports igsr, never the
other way round.
"""
