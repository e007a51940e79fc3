"""One recipe per use."""
