"""Recorded markers and simulated bodies: what the page of results asks for."""
