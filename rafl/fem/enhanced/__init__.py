"""Cells with one integration point and stabilised hourglass modes."""
