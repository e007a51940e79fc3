"""What is fitted: parameter records and differentiable mesh operations."""
