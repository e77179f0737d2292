"""Version of the package, stored in every file that it writes."""

VERSION = "0.1.0"
