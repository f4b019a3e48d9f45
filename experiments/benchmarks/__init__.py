"""Benchmarks of tvsbayes against its peers; `python -m experiments.benchmarks --help` from the repository's root."""

import sys
from pathlib import Path

# The studies beside this package import one another as scripts do.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
