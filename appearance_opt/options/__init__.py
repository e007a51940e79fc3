"""Options: one frozen record per subject, whose fields say default, range and help once. They import
nothing heavy, so that help is fast; ``jobs`` composes them into those of each job."""
