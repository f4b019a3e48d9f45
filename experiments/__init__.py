"""Studies behind the numbers that this project states; run from the root as `python -m experiments.QUESTION.SCRIPT`."""

import os

# Read by NumPy's OpenBLAS when it is loaded, which is after this: its waiting threads would take XLA's time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
