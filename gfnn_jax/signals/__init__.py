"""Traits of sampled series by themselves: noise, resolution, derivatives, frequencies, losses.

Times come as a list of arrays, one of each run; they rise, may be uneven and have gaps. Columns are
(C, T), the runs one after another; values may be missing (NaN). NumPy and SciPy only.
"""
