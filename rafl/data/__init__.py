"""Datasets: markers embedded in the mesh, recordings, and the objective that compares them with a simulation."""
