"""A specimen described on the page from a recording at rest: the corners of its body, its dots, specimen.yaml."""
