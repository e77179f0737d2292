"""Recordings placed on the specimen: rigid registration, release time, first frame."""
