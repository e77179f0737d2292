"""Detection of the points of calibration boards in images."""
