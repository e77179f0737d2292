"""Registration of recordings to the specimen: poses, places of the markers, the first frame."""
