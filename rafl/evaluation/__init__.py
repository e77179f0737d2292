"""Fitted models judged on recordings: error tables, oscillation, reports."""
