"""Runs the command as `python -m tvsbayes`, also where the script `tvsbayes` is not installed."""

from tvsbayes.cli.main import main

main()
