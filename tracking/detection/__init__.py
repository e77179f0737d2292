"""Dots found in a frame and fitted as soft-edged ellipses."""
