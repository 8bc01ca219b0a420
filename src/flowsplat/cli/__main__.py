"""``python -m flowsplat.cli``."""

from flowsplat.cli.entry import main

main()
