"""What recipes are made of: a start, its growth, displacement, the fit, what is written of it."""
