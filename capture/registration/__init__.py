"""Registration of recordings to the specimen: rigid transforms, the release, the first frame."""
