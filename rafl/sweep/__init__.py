"""Many fits and evaluations from one plan: datasets, methods, seeds, options, folds and transfer matrices."""
