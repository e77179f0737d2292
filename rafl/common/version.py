"""The version of the package, which every file that it writes carries."""

VERSION = "0.1.0"
