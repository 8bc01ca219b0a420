"""``python -m flowsplat``: the command line, where the command ``flowsplat`` is not on the path."""

from flowsplat.cli import main

if __name__ == "__main__":
    main()
