"""Reference renderers: black boxes that take views and hand out linear images."""
