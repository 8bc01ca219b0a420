"""The static scene behind objects, for masks and depth: matches over many frames, multi-view depth, fusion, filling."""
