"""Videos read frame by frame: decoding, timestamps, damage and compression."""
