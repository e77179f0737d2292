"""Independent commands, called units, run on this machine or on a cluster, once each, and resumed."""
