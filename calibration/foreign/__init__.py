"""Calibrations that other programs wrote: OpenCV, aniposelib, Caliscope, MATLAB and DLT coefficients."""
