"""Read videos frame by frame: decoding, timestamps, damage and compression."""
