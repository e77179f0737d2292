"""Camera models, rigs and their calibration from board images."""
