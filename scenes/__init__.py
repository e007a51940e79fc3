"""Procedural scenes of this project: ``python -m scenes.build --list``. Nothing here is
downloaded."""
