"""Code that all packages share: errors, atomic files, YAML files, the command line, marker tables."""
