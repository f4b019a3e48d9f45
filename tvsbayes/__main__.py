"""`python -m tvsbayes`: the command, also where no script of that name was installed."""

from tvsbayes.cli.main import main

main()
