"""The release: when a specimen is let go, and from which frame on its motion is free."""
