"""The differentiable deferred renderer: surface, material and views to an image, and back."""
