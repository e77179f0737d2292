"""Methods that fit a model to recordings: the residual field, system identification, supervised learning."""
