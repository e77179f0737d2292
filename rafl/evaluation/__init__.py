"""Evaluation of fitted models on recordings: error tables, oscillation, reports."""
