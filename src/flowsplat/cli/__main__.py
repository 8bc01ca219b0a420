"""``python -m flowsplat.cli``."""

from flowsplat.cli.entry import main

if __name__ == "__main__":
    main()
