"""3-D positions from pixels, their uncertainty, filled gaps, and the tracks file."""
