"""Options: one frozen record per subject, whose fields say default, range and help once. They import
nothing heavy, so that help is fast; ``config`` composes them into the options of each job."""
