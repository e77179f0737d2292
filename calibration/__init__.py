"""Camera models, rigs and their calibration from pictures of a board."""
