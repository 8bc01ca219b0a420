"""``flowsplat studio``: a page on which a clip becomes a scene without a terminal (docs/studio.md).

The page chooses, and every choice becomes an option of ``flowsplat run`` (``choices``). A run is a process of its own that is
started with this command line (``tasks``) and goes on without the server. What is known of a clip lies in its folder (``project``),
so that a server that is started anew finds it. ``clips`` shows frames and masks before anything runs, ``standing`` reads how far a
run is, ``results`` tells what came of it, ``uploads`` receives clips, ``handlers`` answers the page, ``server`` listens.
"""
