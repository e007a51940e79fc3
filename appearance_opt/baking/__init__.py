"""Closed-form baking: what a heavy mesh looks like, written into the maps of a light one."""
