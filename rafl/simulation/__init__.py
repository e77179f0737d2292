"""The differentiable implicit simulator."""
