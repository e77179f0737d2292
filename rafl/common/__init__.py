"""What every package stands on: errors, files written whole, YAML, the command line's manners."""
