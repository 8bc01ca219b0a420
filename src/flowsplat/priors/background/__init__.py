"""The static scene behind movers, for masks and depth: matches over many frames, multi-view depth, fusion, filling."""
