"""A calibration over its board images: corners, residuals, coverage, and the world with the camera's plane."""
