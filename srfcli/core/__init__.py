"""What everything stands on: errors, files, units, settings, the cache; and the version of the package."""

__version__ = "0.1.0"

# What linear algebra libraries read when NumPy is imported. A sum that is shared by several threads has other last digits than
# one thread's, and the matrices here are too small to gain by them.
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "OMP_NUM_THREADS"), "1"
)
