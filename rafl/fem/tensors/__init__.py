"""The mechanics of the cells in torch tensors, on any device."""
